"""Every command, Python block and settings file of README.md and docs/ is run, on the sample of the package halved."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from seepast import cli
from seepast.datasets import open_dataset
from seepast.demo import SAMPLE
from seepast.rig import Rig
from seepast.settings import planned, read_settings

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = {"seepast", "make", "pip", "python", "cp", "eval", "rgbd_tum"}
OUTPUTS = ("--out", "--html", "--video", "--save")
# What a test cannot run here, and why.
NOT_RUN = {
    r"^make (demo|test|docs)": "sets up an environment over the network; what it then runs is tested by itself",
    r"^pip install": "needs the network and a compiler",
    r"^seepast models get": "needs the network; test_segment_models.py fetches from a server of its own",
    r"onnx:pphumanseg": "needs the network that only `models get` brings",
    r" --view$": "serves a page until Ctrl-C; test_viewing.py",
    r"^(ROS_DOMAIN_ID=7 )?seepast serve": "needs a running ROS 2 system; test_serve.py has one of its own",
    r"^rgbd_tum": "is ORB-SLAM's",
    r"--backend cuda": "needs a GPU; test_gpu_frames.py runs the same without",
}
NEEDS = {r"seepast view ": "rerun", r"--to (mcap|rosbag\d)|walk": "rosbags", r"--to exr": "OpenEXR"}
NEEDS |= {r"synth|evaluate": "embreex", r"onnx:": "onnxruntime"}


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """(language, text) of every fenced block of a page, and ("", text) of every indented one."""
    text = page.read_text()
    for language, body in re.findall(r"^```([a-z]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield language, body
    rest = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    for body in re.findall(r"(?:^ {4}.*\n)+", rest, re.MULTILINE):
        yield "", re.sub(r"^ {4}", "", body, flags=re.MULTILINE)


def commands(page: Path) -> list[str]:
    """Every command of a page, without the words that explain it."""
    found = []
    for language, body in blocks(page):
        for line in body.splitlines():
            command = re.split(r" {2,}| # ", line)[0].removeprefix(".venv/bin/").strip()
            program = re.sub(r"^(\w+=\S+ )+", "", command).split(" ")[0]
            if language == "sh" and command:
                assert program in PROGRAMS, f"{page.name}: what is {program}?"
            if language in ("sh", "") and program in PROGRAMS and " " in command:
                found.append(command)
    return found


def named_files() -> dict[tuple[str, str], str]:
    """(page, name) -> text of every block that begins with a comment that names its file, # mine.py."""
    found = {}
    for page in PAGES:
        for language, body in blocks(page):
            name = re.match(r"# ([\w]+\.(?:py|yaml))\b", body)
            if language and name:
                found[page.name, name[1]] = body
    return found


TUTORIAL = "tutorial.md"
ALL = [(page.name, command) for page in PAGES for command in commands(page)]
FILES = named_files()
PYTHON = [
    pytest.param(body, id=f"{page.name}-{n}")
    for page in PAGES
    if page.name != TUTORIAL
    for n, (language, body) in enumerate(blocks(page))
    if language == "python" and not re.match(r"# \w+\.py", body)
]


def halved(target: Path) -> Path:
    """The sample of the package at half its size, without truth."""
    sample = open_dataset(SAMPLE)
    size = tuple(n // 2 for n in sample.rig.cameras[0].resolution)
    intrinsics = sample.rig.cameras[0].intrinsics
    spacing = float(np.linalg.norm(sample.rig.cameras[1].center))
    center = ((intrinsics[2] - 0.5) / 2, (intrinsics[3] - 0.5) / 2)
    rig = Rig.linear(len(sample.rig), focal=intrinsics[0] / 2, spacing=spacing, size=size, center=center)
    for frame in sample:
        for kind, images in (("", frame.images), ("masks", frame.masks or ()), ("masks_net", frame.masks or ())):
            for camera, image in zip(rig.cameras, images, strict=True):
                path = target / kind / camera.name / f"{frame.stamp}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    rig.to_kalibr(target / "rig.yaml")
    return target


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that commands of the documentation name: recordings, bags, a network, a finished run ..."""
    here = tmp_path_factory.mktemp("things")
    recording = halved(here / "recording")
    shutil.copytree(recording, here / "recordings" / "one")
    shutil.copytree(recording, here / "recordings" / "two")
    (here / "mymodule.py").write_text(
        "from seepast.datasets import Reader, open_dataset\n"
        "READER = Reader(lambda path: True, lambda path, options: open_dataset('recording', masks=options.masks))\n"
    )
    for (_, name), text in FILES.items():
        (here / name).write_text(text)
    shutil.copy(recording / "rig.yaml", here / "rig.yaml")  # not the beginning of one that a page shows
    assert cli.main(["run", str(recording), "--out", str(here / "out"), "--preset", "paper"]) == 0
    _add_deep(here / "raw")
    _add_bags(here)
    _add_network(here / "net.onnx")
    _add_truth(here)
    return here


def _add_deep(path: Path) -> None:
    """The recording as a camera of 12 bits would save it."""
    shutil.copytree(path.parent / "recording", path)
    for file in path.glob("cam*/*.png"):
        cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.uint16) * 16)


def _add_bags(here: Path) -> None:
    try:
        from bags import START, Shot, write_bag
    except ImportError:  # those who need bags are skipped
        return
    frame = next(iter(open_dataset(here / "recording")))
    topics: dict[str, Any] = {}
    for k, (image, mask) in enumerate(zip(frame.images, frame.masks or (), strict=True)):
        topics[f"/cam{k}/image_raw"] = [Shot(START, image)]
        topics[f"/cam{k}/mask"] = [Shot(START, mask, "mono8")]
    write_bag(here / "walk.bag", "rosbag1", topics)
    folder = write_bag(here / "walk", "mcap", topics)
    shutil.copy(next(folder.glob("*.mcap")), here / "walk.mcap")


def _add_network(path: Path) -> None:
    try:
        import onnx_nets
    except ImportError:
        return
    onnx_nets.logits(path, np.random.default_rng(0).normal(size=(19, 3)))  # as many classes as Cityscapes has


def _add_truth(here: Path) -> None:
    try:
        import embreex  # noqa: F401
    except ImportError:
        return
    made = ["synth", str(here / "made"), "--rig", str(here / "rig.yaml"), "--frames", "1", "--samples", "1"]
    assert cli.main(made) == 0


@pytest.fixture
def here(things: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory of its own that holds all of `things`."""
    shutil.copytree(things, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    return tmp_path / "here"


def made_by(words: Sequence[str]) -> list[Path]:
    """The files and folders that a command makes, as far as it names them."""
    made = [Path(words[i + 1]) for i, word in enumerate(words) if word in OUTPUTS]
    return made + ([Path(words[2])] if words[:2] == ["seepast", "synth"] else [])


def test_the_documentation_shows_every_command_and_they_are_all_known() -> None:
    shown = {name for _, command in ALL for name in re.findall(r"seepast ([a-z]+)", command)}
    assert {name for name in cli.app if not name.startswith("-")} - {"serve"} <= shown
    assert (
        len(ALL) > 60 and len(PYTHON) >= 3 and {name for _, name in FILES} == {"mine.py", "settings.yaml", "rig.yaml"}
    )


@pytest.mark.parametrize("pattern", NOT_RUN)
def test_the_list_of_what_is_not_run_holds_no_more_than_it_must(pattern: str) -> None:
    assert any(re.search(pattern, command) for _, command in ALL)


@pytest.mark.parametrize(("page", "command"), [pair for pair in ALL if pair[0] != TUTORIAL])
def test_it_runs(page: str, command: str, here: Path) -> None:
    why = why_not(command)
    if why:
        pytest.skip(why)
    for pattern, module in NEEDS.items():
        if re.search(pattern, command):
            pytest.importorskip(module)
    for one in command.split(" && "):
        _run(one, here)


def test_the_tutorial_runs_in_order_from_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    for page, command in ALL:
        if page == TUTORIAL and not why_not(command):
            _run(command, tmp_path)
    for language, body in blocks(ROOT / "docs" / TUTORIAL):
        if language == "python":
            subprocess.run([sys.executable, "-c", body], check=True, cwd=tmp_path)


def why_not(command: str) -> str | None:
    return next((why for pattern, why in NOT_RUN.items() if re.search(pattern, command)), None)


def _run(command: str, here: Path) -> None:
    words = shlex.split(command)
    made = made_by(words)
    for path in made:
        _remove(path)
    if words[0] == "seepast" and not re.search(r"[>|]", command):
        assert cli.main(words[1:]) == 0
    else:
        if words[0] == "cp":
            _remove(Path(words[-1]))
        done = subprocess.run(["bash", "-ec", command], capture_output=True, text=True, cwd=here)
        assert done.returncode == 0 and not done.stderr, done.stderr
    assert all(path.exists() for path in made)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def test_the_pages_build_without_a_warning_and_with_all_pictures(tmp_path: Path) -> None:
    for module in ("sphinx", "furo", "myst_parser"):
        pytest.importorskip(module)
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("made"))
    for name in ("DESIGN.md", "TROUBLESHOOTING.md"):
        shutil.copy(ROOT / name, tmp_path / name)
    build = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", "html"]
    done = subprocess.run(build, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    commands_page = (tmp_path / "html" / "commands.html").read_text()
    assert all(f"<h2>seepast {name}<" in commands_page for name in cli.app if not name.startswith("-"))
    for picture in (tmp_path / "docs" / "made").glob("*.png"):
        image = cv2.imread(str(picture))
        assert min(image.shape[:2]) > 200 and image.std() > 20, picture.name


@pytest.mark.parametrize("body", PYTHON)
def test_its_python_runs(body: str, here: Path) -> None:
    done = subprocess.run([sys.executable, "-c", body], capture_output=True, text=True, cwd=here)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("page", "name"), FILES)
def test_its_files_are_what_they_say(page: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(FILES[page, name])
    if name == "settings.yaml":
        plan = planned({"dataset": "recording"}, {}, read_settings(path))
        assert plan.reference == "cam2" and plan.options.range.max_disparity == 150
    elif name == "rig.yaml":
        assert len(Rig.from_kalibr(path)) == 2
    else:
        compile(path.read_text(), name, "exec")


def test_links_and_pictures_of_the_pages_are_there() -> None:
    """Those that docs/pictures.py makes are named by it."""
    script = (ROOT / "docs" / "pictures.py").read_text()
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            if target.startswith("made/"):
                assert f'"{Path(target).stem}": ' in script, target
            else:
                assert (page.parent / target).exists(), (page.name, target)
