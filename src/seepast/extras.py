"""Optional dependencies: imported by the function that needs them, named in the error where they are missing."""

from __future__ import annotations

import importlib
from typing import Any

from .errors import MissingExtraError


def require(module: str, extra: str, purpose: str) -> Any:
    """Import `module`. Raises MissingExtraError, which names the extra of seepast that brings it, where it is missing.

    purpose  what cannot be done without it, for the message: "seepast export --to exr"
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(module.partition(".")[0], extra, purpose) from error
