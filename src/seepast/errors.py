"""Every error seepast raises on purpose. Each message names the file or argument, what is wrong, and the mend."""


class SeepastError(Exception):
    """Base class: catch this to catch whatever seepast says about its input."""


class RigError(SeepastError, ValueError):
    """A calibration that cannot be used: unreadable, singular, unsupported, or not an array that sees one way."""


class InputError(SeepastError, ValueError):
    """Images or masks of the wrong number, size, type or content."""


class OptionsError(SeepastError, ValueError):
    """An option that does not exist or lies outside its range."""


class DatasetError(SeepastError, ValueError):
    """A dataset folder with missing, unreadable or contradictory files."""


class OutputError(SeepastError, OSError):
    """An output that cannot be written, or that already holds something else."""


class BackendError(SeepastError, RuntimeError):
    """A backend that is unknown or cannot run on this machine."""


class DeviceError(BackendError):
    """A GPU that cannot go on with a frame: its memory is full, or it was lost."""


class ModelError(SeepastError, RuntimeError):
    """A segmentation network that cannot be found, fetched, read, understood or run."""


class TransportError(SeepastError, RuntimeError):
    """A running system that cannot be reached, or that does not take what is published."""


class MissingExtraError(SeepastError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it."""

    def __init__(self, package: str, extra: str, purpose: str):
        super().__init__(f"{purpose} needs the package '{package}': pip install 'seepast[{extra}]'")
