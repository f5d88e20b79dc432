"""What this installation is made of: version, backends, processor, libraries, extras."""

from __future__ import annotations

import os
import platform
import re
from importlib import metadata
from typing import Any

import cv2
import numpy as np

from . import __version__, backends
from .errors import SeepastError
from .gpu import device

FOR_DEVELOPERS = {"test", "dev", "docs"}


def about() -> dict[str, Any]:
    """What `seepast --version --json` prints.

    seepast, python, numpy, opencv  versions
    machine, cores                  the processor's architecture; cores that this process may use
    simd                            "AVX-512", "AVX2", "NEON" or "baseline": the loops that the cpu backend chose for
                                    this processor; None where it cannot be loaded
    backends                        name -> None where it works, else why it does not
    gpu                             its name and compute capability, as the cuda backend has it; None without
    extras                          name -> {package: version, None where it is missing}
    """
    return {
        "seepast": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "machine": platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "simd": simd(),
        "backends": {name: _why_not(name) for name in backends.BACKENDS},
        "gpu": gpu(),
        "extras": extras(),
    }


def about_text(facts: dict[str, Any]) -> str:
    """The same for people, in a few lines."""
    lines = [f"seepast {facts['seepast']}"]
    lines += [f"backend {name}: {'found' if why is None else why}" for name, why in facts["backends"].items()]
    lines.append(f"processor: {facts['machine']}, SIMD {facts['simd'] or 'not known'}, {facts['cores']} cores")
    lines.append(f"python {facts['python']}, numpy {facts['numpy']}, opencv {facts['opencv']}")
    if facts["gpu"]:
        lines.append(f"gpu: {facts['gpu']}")
    for extra, packages in facts["extras"].items():
        missing = [package for package, version in packages.items() if version is None]
        there = ", ".join(f"{package} {version}" for package, version in packages.items())
        lines.append(f"extra {extra}: " + (f"pip install 'seepast[{extra}]'" if missing else there))
    return "\n".join(lines)


def simd() -> str | None:
    """The instruction set whose loops the cpu backend runs here; None where it cannot be loaded."""
    try:
        from . import _core
    except ImportError:
        return None
    return str(_core.simd())


def gpu() -> str | None:
    """The GPU of the cuda backend: "NVIDIA H200, compute capability 9.0, CUDA 12"; None where there is none."""
    try:
        return device.current().name
    except SeepastError:
        return None


def extras(names: list[str] | None = None, requirements: list[str] | None = None) -> dict[str, dict[str, str | None]]:
    """Every extra for users, with its packages and their versions; None for a package that is missing.

    names, requirements  Provides-Extra and Requires-Dist of the package; None = those of seepast as it is installed
    """
    if names is None or requirements is None:
        try:
            own = metadata.metadata("seepast")
        except metadata.PackageNotFoundError:  # run from the source tree
            return {}
        names, requirements = own.get_all("Provides-Extra") or [], own.get_all("Requires-Dist") or []
    found: dict[str, dict[str, str | None]] = {name: {} for name in names if name not in FOR_DEVELOPERS}
    for requirement in requirements:
        package = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"]([\w.-]+)['\"]", requirement)
        if package and extra and extra[1] in found:
            found[extra[1]][package[0]] = _version(package[0])
    return {name: packages for name, packages in found.items() if packages}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _why_not(backend: str) -> str | None:
    try:
        backends.get(backend)
    except SeepastError as error:
        return str(error)
    return None
