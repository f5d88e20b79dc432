"""Fetching a public model: verified, resumed where it broke off, there as a whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import logging
import os
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

from ..errors import ModelError, OutputError
from .models import PublicModel

log = logging.getLogger("seepast")

TIMEOUT = 30.0  # seconds without a byte
CHUNK = 1 << 16
RANGE_NOT_SATISFIABLE = 416


def fetch(model: PublicModel, path: Path, on_bytes: Callable[[int], None] = lambda n: None) -> bool:
    """Leave `model` at `path`; False if it was there already.

    What came before the line broke stays in a hidden file beside `path`, and the next call asks for the rest (HTTP
    Range); a server that cannot do that sends all again. `on_bytes` is told how many bytes there are so far.

    Raises ModelError: no connection, an answer that is no file, or bytes with another SHA-256, which are removed.
    OutputError where `path` cannot be written.
    """
    if path.is_file() and _sha256(path) == model.sha256:
        return False
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        resumed = _download(model, part, on_bytes)
        if resumed and _sha256(part) != model.sha256:
            log.warning("%s: what lay there from before does not fit; fetching all of it again", path)
            part.unlink()
            _download(model, part, on_bytes)
        _verify(model, part)
        os.replace(part, path)
    except urllib.error.HTTPError as error:
        raise ModelError(f"{model.address}: the server says {error.code} {error.reason}; try again later") from error
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError, ssl.SSLError) as error:
        reason = getattr(error, "reason", None) or error
        raise ModelError(
            f"{model.address}: no connection ({reason}); with a network, say the same again and it goes on, or fetch "
            f"it by other means to {path}"
        ) from error
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}); name another folder") from error
    return True


def _download(model: PublicModel, part: Path, on_bytes: Callable[[int], None]) -> bool:
    """Bring `part` to its full length; True if it began with bytes from before."""
    before = part.stat().st_size if part.exists() else 0
    if before >= model.bytes:  # complete, or too much: the hash will tell
        return True
    request = urllib.request.Request(model.address, headers={"User-Agent": "seepast"})
    if before:
        request.add_header("Range", f"bytes={before}-")
    try:
        answer = urllib.request.urlopen(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        if not (before and error.code == RANGE_NOT_SATISFIABLE):
            raise
        error.close()
        part.unlink()
        return _download(model, part, on_bytes)
    with answer:
        resumed = answer.status == 206 and answer.headers.get("Content-Range", "").startswith(f"bytes {before}-")
        _append(answer, part, before if resumed else 0, model, on_bytes)
    return resumed


def _append(
    answer: http.client.HTTPResponse, part: Path, start: int, model: PublicModel, on_bytes: Callable[[int], None]
) -> None:
    """Write the answer's body to `part` from `start` on. Raises ConnectionError where it ends too soon."""
    there = start
    with part.open("r+b" if start else "wb") as file:
        file.seek(start)
        while chunk := answer.read(CHUNK):
            file.write(chunk)
            there += len(chunk)
            on_bytes(there)
            if there > model.bytes:
                break
    if there < model.bytes and answer.length:  # the server promised more than it sent
        raise ConnectionError(f"broke off after {there} of {model.bytes} bytes")


def _verify(model: PublicModel, part: Path) -> None:
    found, size = _sha256(part), part.stat().st_size
    if found == model.sha256:
        return
    with contextlib.suppress(OSError):
        part.unlink()
    raise ModelError(
        f"{model.address}: sent {size} bytes with SHA-256 {found}, but {model.bytes} bytes with {model.sha256} are "
        "expected; they were removed. The file has been replaced there, or something stands in between: do not use it"
    )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()
