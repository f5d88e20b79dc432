"""Fetching public models: verified, resumed, whole or not at all, clear when there is no network."""

from __future__ import annotations

import hashlib
import http.server
import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from seepast import cli
from seepast.errors import ModelError, OutputError
from seepast.segment import fetch as fetching
from seepast.segment import models, open_segmenter
from seepast.segment.fetch import fetch
from seepast.segment.models import MODELS, PublicModel

BODY = bytes(range(256)) * 1200  # more than one chunk
SHA256 = hashlib.sha256(BODY).hexdigest()


@dataclass
class Server:
    """What the server sends, and what it was asked for."""

    body: bytes = BODY
    ranges: bool = True
    break_after: int | None = None  # bytes of an answer after which the line breaks, once
    status: int = 200
    asked: list[str | None] = field(default_factory=list)  # the Range of every request
    port: int = 0

    @property
    def model(self) -> PublicModel:
        return PublicModel("a test", "none", f"http://127.0.0.1:{self.port}/net.onnx", len(BODY), SHA256, "selfie")


@pytest.fixture
def server() -> Iterator[Server]:
    state = Server()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = self.headers.get("Range")
            state.asked.append(asked)
            start = int(asked.removeprefix("bytes=").rstrip("-")) if asked and state.ranges else 0
            if state.status != 200 or start >= len(state.body):
                self.send_error(state.status if state.status != 200 else 416)
                return
            part = state.body[start:]
            self.send_response(206 if start else 200)
            self.send_header("Content-Length", str(len(part)))
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(state.body) - 1}/{len(state.body)}")
            self.end_headers()
            sent, state.break_after = part[: state.break_after], None
            self.wfile.write(sent)
            self.close_connection = True

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as httpd:
        state.port = httpd.server_address[1]
        thread = threading.Thread(target=httpd.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield state
        httpd.shutdown()
        thread.join()


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def test_it_is_fetched_once_and_counted(server: Server, tmp_path: Path) -> None:
    counted: list[int] = []
    path = tmp_path / "new" / "net.onnx"
    assert fetch(server.model, path, counted.append)
    assert path.read_bytes() == BODY and names(path.parent) == {"net.onnx"}
    assert counted == sorted(counted) and counted[-1] == len(BODY) and len(counted) > 1
    assert not fetch(server.model, path)
    assert server.asked == [None]


def test_a_file_that_was_changed_is_fetched_again(server: Server, tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    path.write_bytes(BODY[:-1] + b"?")
    assert fetch(server.model, path)
    assert path.read_bytes() == BODY


@pytest.mark.parametrize("ranges", [True, False])
def test_a_broken_line_is_told_and_gone_on_from(server: Server, tmp_path: Path, ranges: bool) -> None:
    server.ranges, server.break_after = ranges, 100_000
    path = tmp_path / "net.onnx"
    with pytest.raises(ModelError, match=r"no connection \(broke off after 100000 of 307200 bytes\); .* it goes on"):
        fetch(server.model, path)
    assert names(tmp_path) == {".net.onnx.part"}
    counted: list[int] = []
    assert fetch(server.model, path, counted.append)
    assert path.read_bytes() == BODY and names(tmp_path) == {"net.onnx"}
    assert server.asked == [None, "bytes=100000-"]
    assert (counted[0] > 100_000) == ranges  # without ranges it begins anew


def test_what_lay_there_from_before_and_does_not_fit_is_fetched_anew(server: Server, tmp_path: Path) -> None:
    (tmp_path / ".net.onnx.part").write_bytes(b"x" * 5000)
    assert fetch(server.model, tmp_path / "net.onnx")
    assert (tmp_path / "net.onnx").read_bytes() == BODY and server.asked == ["bytes=5000-", None]


def test_all_bytes_there_but_not_yet_verified(server: Server, tmp_path: Path) -> None:
    (tmp_path / ".net.onnx.part").write_bytes(BODY)
    assert fetch(server.model, tmp_path / "net.onnx")
    assert (tmp_path / "net.onnx").read_bytes() == BODY and server.asked == []


def test_more_than_the_server_has(server: Server, tmp_path: Path) -> None:
    server.body = BODY[:1000]
    model = replace(server.model, sha256=hashlib.sha256(server.body).hexdigest())
    (tmp_path / ".net.onnx.part").write_bytes(b"x" * 2000)
    assert fetch(model, tmp_path / "net.onnx")
    assert server.asked == ["bytes=2000-", None]


@pytest.mark.parametrize("body", [BODY[:-1] + b"?", b"<html>Please log in</html>", BODY + BODY])
def test_other_bytes_are_refused_and_removed(server: Server, tmp_path: Path, body: bytes) -> None:
    server.body = body
    with pytest.raises(ModelError, match=rf"with SHA-256 .* but 307200 bytes with {SHA256} are expected; .* removed"):
        fetch(server.model, tmp_path / "net.onnx")
    assert names(tmp_path) == set()


def test_an_error_of_the_server(server: Server, tmp_path: Path) -> None:
    server.status = 404
    with pytest.raises(ModelError, match=r"127.0.0.1:\d+/net.onnx: the server says 404 Not Found"):
        fetch(server.model, tmp_path / "net.onnx")
    assert names(tmp_path) == set()


def test_no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and never listens
        model = replace(Server().model, address=f"http://127.0.0.1:{taken.getsockname()[1]}/net.onnx")
        with pytest.raises(ModelError, match=r"no connection \(.*refused.*\).* by other means to .*net.onnx"):
            fetch(model, tmp_path / "net.onnx")


def test_a_server_that_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetching, "TIMEOUT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        model = replace(Server().model, address=f"http://127.0.0.1:{silent.getsockname()[1]}/net.onnx")
        with pytest.raises(ModelError, match=r"no connection \(timed out\)"):
            fetch(model, tmp_path / "net.onnx")


def test_a_folder_that_cannot_be_made(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match=r"cannot be written .*; name another folder"):
        fetch(server.model, tmp_path / "file" / "net.onnx")


# --------------------------------------------------------------------------------------------- commands
def test_the_table_says_what_everybody_needs_to_know(capsys: pytest.CaptureFixture[str], tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("SEEPAST_MODELS", str(tmp_path))
    assert cli.main(["models"]) == 0
    printed = capsys.readouterr().out
    for name, model in MODELS.items():
        assert all(str(fact) in printed for fact in (name, model.licence, model.address, model.sha256, model.bytes))
        assert len(model.sha256) == 64 and model.address.startswith("https://")
    assert "(fetched)" not in printed
    assert cli.main(["models", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pphumanseg"]["bytes"] == 6163938


def test_get_leaves_it_where_the_segmenter_finds_it_by_name(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import onnx_nets

    server.body = onnx_nets.selfie(tmp_path / "made.onnx", (1, 0, 0)).read_bytes()
    sha256 = hashlib.sha256(server.body).hexdigest()
    known = replace(server.model, bytes=len(server.body), sha256=sha256, preset="people")
    monkeypatch.setitem(models.MODELS, "mine", known)
    monkeypatch.setenv("SEEPAST_MODELS", str(tmp_path / "models"))
    with pytest.raises(ModelError, match="mine: not fetched yet; say `seepast models get mine` once"):
        open_segmenter("onnx:mine")
    assert server.asked == []  # nothing is fetched unasked
    assert cli.main(["models", "get", "mine"]) == 0
    assert capsys.readouterr().out.startswith(str(tmp_path / "models" / "mine.onnx"))
    said = open_segmenter("onnx:mine").describe()
    assert (said["preset"], said["sha256"]) == ("people", sha256)
    assert cli.main(["models", "get", "mine", "--to", str(tmp_path / "elsewhere")]) == 0
    assert (tmp_path / "elsewhere" / "mine.onnx").read_bytes() == server.body


def test_get_of_an_unknown_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["models", "get", "nothing"]) == 2
    assert "no such model; `seepast models` lists pphumanseg" in capsys.readouterr().err
