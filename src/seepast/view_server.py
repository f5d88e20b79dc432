"""The rerun web viewer as a child process that listens on this machine only."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from .errors import OutputError
from .extras import require

HOST = "127.0.0.1"
WEB_PORT = 9090
START_SECONDS = 30.0


@dataclass(frozen=True)
class ViewServer:
    """page: address for a browser; grpc: address for RecordingStream.connect_grpc; process: the server."""

    page: str
    grpc: str
    process: subprocess.Popen[bytes]

    def wait(self) -> None:
        """Until the server ends, or Ctrl-C, which is how one leaves it."""
        with contextlib.suppress(KeyboardInterrupt):
            self.process.wait()


@contextlib.contextmanager
def connected(stream: Any, server: ViewServer) -> Iterator[None]:
    """What is logged to the rerun.RecordingStream within goes to `server`; to be left before the server ends."""
    stream.connect_grpc(server.grpc)
    try:
        yield
    finally:
        stream.disconnect()


@contextlib.contextmanager
def view_server(web_port: int = WEB_PORT) -> Iterator[ViewServer]:
    """Serve the web viewer at http://127.0.0.1:web_port (0: any free port) and take data at another free port.

    rerun's own default is to listen on all interfaces; this passes --bind 127.0.0.1. The server ends with the
    `with` block. Raises MissingExtraError, OutputError where the port is taken or the server does not start.
    """
    require("rerun", "view", "the viewer")
    web_port = web_port or _free_port()
    if not _free(web_port):
        raise OutputError(f"port {web_port} of {HOST} is taken; name another with --port, or 0 for any free one")
    grpc_port = _free_port()
    command = [sys.executable, "-m", "rerun", "--serve-web", "--bind", HOST, "--hide-welcome-screen"]
    command += ["--web-viewer-port", str(web_port), "--port", str(grpc_port)]
    nowhere = subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere, start_new_session=True)
    try:
        _wait_for(process, (web_port, grpc_port))
        grpc = f"rerun+http://{HOST}:{grpc_port}/proxy"
        yield ViewServer(f"http://{HOST}:{web_port}/?url={quote(grpc, safe='')}", grpc, process)
    finally:
        _end(process)
        _wait_until_free((web_port, grpc_port))


def _end(process: subprocess.Popen[bytes]) -> None:
    """`python -m rerun` starts the server proper as a child of its own: both must go."""
    for blow in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, blow)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5)


def _wait_for(process: subprocess.Popen[bytes], ports: tuple[int, ...]) -> None:
    end = time.monotonic() + START_SECONDS
    while not all(_listening(port) for port in ports):
        if process.poll() is not None or time.monotonic() > end:
            raise OutputError(
                "the rerun viewer did not start; `python -m rerun --serve-web` tells why, --save FILE does without it"
            )
        time.sleep(0.1)


def _wait_until_free(ports: tuple[int, ...]) -> None:
    """What was killed takes a moment to let go of its ports."""
    end = time.monotonic() + 5
    while any(_listening(port) for port in ports) and time.monotonic() < end:
        time.sleep(0.02)


def _listening(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((HOST, port)) == 0


def _free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError):
            return False
        return True


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
