"""What this installation is made of: version, backends, processor, libraries, extras."""

from __future__ import annotations

import os
import platform
import re
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from . import __version__, backends
from .errors import BackendError

FOR_DEVELOPERS = {"test", "dev", "docs"}
# The levels of x86-64 that the hot loops are compiled for, with the flags by which Linux tells that they are there.
_LEVELS = {
    "x86-64-v4 (AVX-512)": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "x86-64-v3 (AVX2)": {"avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"},
}


def about() -> dict[str, Any]:
    """What `seepast --version --json` prints.

    seepast, python, numpy, opencv  versions
    machine, cores                  the processor's architecture; cores that this process may use
    simd                            what loops are chosen for this processor where the compiler was gcc; None: not known
    backends                        name -> None where it works, else why it does not
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
        "extras": extras(),
    }


def about_text(facts: dict[str, Any]) -> str:
    """The same for people, in a few lines."""
    lines = [f"seepast {facts['seepast']}"]
    lines += [f"backend {name}: {'found' if why is None else why}" for name, why in facts["backends"].items()]
    lines.append(f"processor: {facts['machine']}, SIMD {facts['simd'] or 'not known'}, {facts['cores']} cores")
    lines.append(f"python {facts['python']}, numpy {facts['numpy']}, opencv {facts['opencv']}")
    for extra, packages in facts["extras"].items():
        missing = [package for package, version in packages.items() if version is None]
        there = ", ".join(f"{package} {version}" for package, version in packages.items())
        lines.append(f"extra {extra}: " + (f"pip install 'seepast[{extra}]'" if missing else there))
    return "\n".join(lines)


def simd(flags: set[str] | None = None) -> str | None:
    """The best of the instruction sets that loops are compiled for and the processor has; None: not known.

    flags  of the processor as Linux names them; None = those of this one
    """
    if platform.machine() in ("aarch64", "arm64"):
        return "NEON"
    flags = _processor_flags() if flags is None else flags
    if not flags or platform.machine() not in ("x86_64", "AMD64"):
        return None
    return next((level for level, needs in _LEVELS.items() if needs <= flags), "x86-64 (SSE2)")


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
    except BackendError as error:
        return str(error)
    return None


def _processor_flags() -> set[str]:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return set()
    line = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    return set(line[1].split()) if line else set()
