"""ROS bags in: ROS 1, ROS 2 in sqlite3 and MCAP, raw and compressed."""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from bags import KINDS, START, Shot, write_bag
from recordings import SIZE, save, write_recording
from seepast.cli import main
from seepast.datasets import find_datasets, open_dataset
from seepast.datasets.bag_file import BagFile
from seepast.datasets.rosbag import RosbagDataset
from seepast.errors import DatasetError, MissingExtraError, RigError
from seepast.rig import Rig

PERIOD, MS = 50_000_000, 1_000_000
STAMPS = [START + n * PERIOD for n in range(6)]
JITTER = (0, 1_500_000, -2_000_000)  # of cam0, cam1, cam2
NAMES = {"rosbag1": "walk.bag", "sqlite3": "walk", "mcap": "walk"}


def picture(camera: int, frame: int, color: bool = True) -> np.ndarray:
    rng = np.random.default_rng([camera, frame])
    return rng.integers(0, 255, (SIZE[1], SIZE[0], 3) if color else (SIZE[1], SIZE[0]), np.uint8)


def shots(camera: int, frames: range = range(6), **how: object) -> list[Shot]:
    return [Shot(STAMPS[n] + JITTER[camera], picture(camera, n), **how) for n in frames]


def topic(camera: int) -> str:
    return f"/cam{camera}/image_raw"


def make(folder: Path, kind: str, topics: dict[str, list[Shot]]) -> Path:
    folder.mkdir(exist_ok=True)
    Rig.linear(3, focal=48.0, spacing=0.1, size=SIZE).to_kalibr(folder / "rig.yaml")
    return write_bag(folder / NAMES[kind], kind, topics)


@pytest.mark.parametrize("kind", KINDS)
def test_jittered_and_lost_images_are_put_together(kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    topics = {topic(k): shots(k) for k in range(3)}
    del topics[topic(1)][2]  # cam1 loses frame 2
    del topics[topic(2)][4:]  # cam2 stops early
    topics["/notes"] = [Shot(START, np.zeros(0), "text")]
    with caplog.at_level(logging.WARNING, "seepast"):
        dataset = open_dataset(make(tmp_path / "r", kind, topics), masks="none")
    assert isinstance(dataset, RosbagDataset)
    assert list(dataset.stamps) == [str(STAMPS[n]) for n in (0, 1, 3)]
    np.testing.assert_array_equal(dataset.times, [[STAMPS[n] + j for j in JITTER] for n in (0, 1, 3)])
    for n, frame in zip((0, 1, 3), dataset, strict=True):
        for k in range(3):
            np.testing.assert_array_equal(frame.images[k], picture(k, n))
    assert {str(d) for d in dataset.dropped} == {
        "2 images: cam1 has no image within 5 ms",
        "4 images: cam2 has no image within 5 ms",
    }
    assert "dropping 6 of 15 images" in caplog.text
    np.testing.assert_array_equal(dataset.frame(dataset.stamps[2]).images[2], picture(2, 3))
    np.testing.assert_array_equal(dataset.frame(dataset.stamps[0]).images[2], picture(2, 0))


@pytest.mark.parametrize("kind", KINDS)
def test_compressed_images_are_found_under_the_raw_topic(kind: str, tmp_path: Path) -> None:
    topics = {f"{topic(k)}/compressed": shots(k, encoding="png") for k in range(2)}
    topics[f"{topic(2)}/compressed"] = shots(2, encoding="jpeg")
    frame = open_dataset(make(tmp_path / "r", kind, topics), masks="none").frame(str(STAMPS[1]))
    np.testing.assert_array_equal(frame.images[0], picture(0, 1))
    jpeg = cv2.imdecode(cv2.imencode(".jpeg", picture(2, 1))[1], cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(frame.images[2], jpeg)


def test_a_run_on_a_bag_is_the_run_on_its_images_in_folders(tmp_path: Path) -> None:
    stamps = [str(stamp) for stamp in STAMPS[:2]]
    folder = write_recording(tmp_path / "folder", stamps=stamps)
    topics: dict[str, list[Shot]] = {}
    for k in range(3):
        for what, name in (("image_raw", f"cam{k}"), ("mask", f"masks/cam{k}")):
            images = [cv2.imread(str(folder / name / f"{s}.png"), cv2.IMREAD_UNCHANGED) for s in stamps]
            encoding = "mono8" if what == "mask" else "bgr8"
            topics[f"/cam{k}/{what}"] = [
                Shot(int(s) + k * MS, i, encoding) for s, i in zip(stamps, images, strict=True)
            ]
    bag = make(tmp_path / "bag", "mcap", topics)
    arguments = ["--preset", "paper", "--threads", "1"]
    assert main(["run", str(folder), "--out", str(tmp_path / "a"), *arguments]) == 0
    assert main(["run", str(bag), "--out", str(tmp_path / "b"), "--masks", "topics:/{}/mask", *arguments]) == 0
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.p??"))
    assert len(files) == 2 * (5 + 3)
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_a_run_does_not_go_on_with_other_topics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = make(tmp_path / "r", "sqlite3", {topic(k): shots(k, range(1)) for k in range(3)})
    arguments = ["run", str(bag), "--out", str(tmp_path / "o"), "--preset", "paper", "--masks", "none"]
    assert main(arguments) == 0 and main(arguments) == 0
    reading = json.loads((tmp_path / "o" / "run.json").read_text())["reading"]
    assert reading == {"reader": "rosbag", "topics": [topic(k) for k in range(3)], "tolerance": 0.005}
    assert main([*arguments, "--topics", f"{topic(1)},{topic(0)},{topic(2)}"]) == 2
    assert "holds the frames of another run (reading: " in capsys.readouterr().err


def test_check_shows_skew_and_losses_and_refocus_reads_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    topics = {topic(k): shots(k) for k in range(3)}
    del topics[topic(1)][2]
    bag = make(tmp_path / "r", "rosbag1", topics)
    assert main(["check", str(bag), "--masks", "none", "--json"]) == 0
    checks = json.loads(capsys.readouterr().out)["checks"]
    assert "3.50 ms in the median" in checks["time-stamp skew"]["value"]
    assert checks["dropped images"]["value"] == "2 of 17; 2 images: cam1 has no image within 5 ms"
    assert checks["dropped images"]["verdict"] == "doubtful" and checks["dropped images"]["images"] == 2
    assert main(["refocus", str(bag), "--out", str(tmp_path / "o"), "--depth", "5"]) == 0
    assert len(list((tmp_path / "o").glob("*.png"))) == len(STAMPS) - 1


RAW = {
    "mono8": lambda bgr: bgr[..., 0],
    "rgb8": lambda bgr: bgr[..., ::-1],
    "bgra8": lambda bgr: np.dstack([bgr, np.full(bgr.shape[:2], 9, np.uint8)]),
    "rgba8": lambda bgr: np.dstack([bgr[..., ::-1], np.full(bgr.shape[:2], 9, np.uint8)]),
    "8UC3": lambda bgr: bgr,
}


@pytest.mark.parametrize("encoding", RAW)
def test_encodings_and_row_padding(encoding: str, tmp_path: Path) -> None:
    bgr = picture(0, 0)
    topics = {topic(k): [Shot(START, RAW[encoding](bgr), encoding, padding=5 * k)] for k in range(3)}
    frame = open_dataset(make(tmp_path / "r", "mcap", topics), masks="none").frame(str(START))
    for image in frame.images:
        np.testing.assert_array_equal(image, bgr[..., 0] if encoding == "mono8" else bgr)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_name_the_top_left_pixels(pattern: str, tmp_path: Path) -> None:
    color = {"b": 200, "g": 120, "r": 40}
    mosaic = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    for n, letter in enumerate(pattern):
        mosaic[n // 2 :: 2, n % 2 :: 2] = color[letter]
    topics = {topic(k): [Shot(START, mosaic, f"bayer_{pattern}8")] for k in range(3)}
    image = open_dataset(make(tmp_path / "r", "sqlite3", topics), masks="none").frame(str(START)).images[0]
    np.testing.assert_array_equal(image[4:-4, 4:-4].reshape(-1, 3), np.tile([200, 120, 40], (28 * 40, 1)))


@pytest.mark.parametrize("encoding", ["16SC1", "32FC1"])
def test_what_are_no_grey_levels_is_refused(encoding: str, tmp_path: Path) -> None:
    deep = np.zeros((SIZE[1], SIZE[0]), np.int16 if encoding == "16SC1" else np.float32)
    bag = make(tmp_path / "r", "mcap", {topic(k): [Shot(START, deep, encoding)] for k in range(3)})
    with pytest.raises(DatasetError, match=rf"/cam0/image_raw at {START}: encoding {encoding} has no grey levels"):
        open_dataset(bag, masks="none").frame(str(START))


def test_topics_may_be_given_in_order_or_by_pattern(tmp_path: Path) -> None:
    bag = make(tmp_path / "r", "rosbag1", {f"/rig/{k}/cam{k}": shots(k) for k in (2, 0, 1)})
    listed = open_dataset(bag, masks="none", topics="/rig/0/cam0, rig/1/cam1,/rig/2/cam2")
    np.testing.assert_array_equal(listed.frame(str(STAMPS[0])).images[1], picture(1, 0))
    swapped = open_dataset(bag, masks="none", topics="/rig/1/cam1,/rig/0/cam0,/rig/2/cam2")
    np.testing.assert_array_equal(swapped.frame(swapped.stamps[0]).images[0], picture(1, 0))
    with pytest.raises(DatasetError, match="give 3 different topics"):
        open_dataset(bag, masks="none", topics="/rig/0/cam0,/rig/1/cam1")
    other = make(tmp_path / "s", "mcap", {f"/cam{k}/left": shots(k) for k in range(3)})
    assert len(open_dataset(other, masks="none", topics="/{}/left").stamps) == len(STAMPS)


def test_a_missing_topic_names_those_that_are_there(tmp_path: Path) -> None:
    topics = {"/a": shots(0), "/b": shots(1), "/notes": [Shot(START, np.zeros(0), "text")]}
    bag = make(tmp_path / "r", "mcap", topics)
    with pytest.raises(
        DatasetError, match=r"names /cam0/image_raw, which is not in the bag; the bag has the images /a, /b"
    ):
        open_dataset(bag, masks="none")
    with pytest.raises(DatasetError, match="--topics names /notes, which is of type std_msgs/msg/String"):
        open_dataset(bag, masks="none", topics="/a,/b,/notes")
    only_text = make(tmp_path / "s", "rosbag1", {"/notes": [Shot(START, np.zeros(0), "text")]})
    with pytest.raises(
        DatasetError,
        match=r"no sensor_msgs/Image, CompressedImage or video, but /notes \(std_msgs/msg/String\)",
    ):
        open_dataset(only_text, masks="none")


def test_a_topic_without_messages_is_named(tmp_path: Path) -> None:
    bag = make(tmp_path / "r", "sqlite3", {topic(0): shots(0), topic(1): [], topic(2): shots(2)})
    with pytest.raises(DatasetError, match="/cam1/image_raw has no messages"):
        open_dataset(bag, masks="none")


def test_the_rig_is_beside_the_bag_in_it_or_given(tmp_path: Path) -> None:
    bag = make(tmp_path / "r", "sqlite3", {topic(k): shots(k) for k in range(3)})
    rig = shutil.move(tmp_path / "r" / "rig.yaml", tmp_path / "calibration.yaml")
    with pytest.raises(RigError, match=r"walk: no calibration; .* --rig FILE"):
        open_dataset(bag, masks="none")
    assert len(open_dataset(bag, masks="none", rig=rig).stamps) == len(STAMPS)
    shutil.copy(rig, bag / "rig.yaml")
    assert len(open_dataset(bag, masks="none").stamps) == len(STAMPS)


def test_images_of_another_size_than_the_rig_says(tmp_path: Path) -> None:
    topics = {topic(k): shots(k) for k in range(3)}
    topics[topic(1)][3] = Shot(STAMPS[3], np.zeros((10, 20, 3), np.uint8))
    dataset = open_dataset(make(tmp_path / "r", "mcap", topics), masks="none")
    dataset.frame(str(STAMPS[0]))
    with pytest.raises(DatasetError, match=rf"/cam1/image_raw at {STAMPS[3]}: is 20x10, but .*rig.yaml says 48x36"):
        dataset.frame(str(STAMPS[3]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_bag_is_named_with_the_mend(kind: str, tmp_path: Path) -> None:
    bag = make(tmp_path / "r", kind, {topic(k): shots(k) for k in range(3)})
    file = bag if bag.is_file() else next(f for f in bag.iterdir() if f.suffix in (".mcap", ".db3"))
    whole = file.read_bytes()
    for kept in (0.6, 0.02):
        file.write_bytes(whole[: int(kept * len(whole))])
        with pytest.raises(DatasetError, match=r"walk.*(damaged|cut off).*reindex"):
            list(open_dataset(bag, masks="none"))
    file.write_bytes(b"")
    with pytest.raises(DatasetError, match="walk"):
        open_dataset(bag, masks="none")


def test_a_database_with_a_time_that_is_none(tmp_path: Path) -> None:
    bag = make(tmp_path / "r", "sqlite3", {topic(k): shots(k) for k in range(3)})
    with contextlib.closing(sqlite3.connect(next(bag.glob("*.db3")))) as database:
        database.execute("UPDATE messages SET timestamp = x'00ff' WHERE id = 7")
        database.commit()
    with pytest.raises(DatasetError, match="walk: cannot be read as a bag"):
        open_dataset(bag, masks="none")


def test_truncated_compressed_images_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encode = cv2.imencode
    monkeypatch.setattr(cv2, "imencode", lambda kind, image: (True, (data := encode(kind, image)[1])[: len(data) // 2]))
    for encoding, problem in (("jpeg", "truncated JPEG"), ("png", "truncated PNG")):
        topics = {topic(k): shots(k, encoding=encoding) for k in range(3)}
        dataset = open_dataset(make(tmp_path / encoding, "mcap", topics), masks="none")
        with pytest.raises(DatasetError, match=rf"/cam0/image_raw at {STAMPS[0]}: {problem}"):
            dataset.frame(str(STAMPS[0]))


def test_masks_in_a_folder_go_by_the_frame_or_by_the_cameras_own_stamp(tmp_path: Path) -> None:
    bag = make(tmp_path / "r", "mcap", {topic(k): shots(k, range(2)) for k in range(3)})
    with pytest.raises(DatasetError, match="no such folder of masks"):
        open_dataset(bag, masks="net")
    for n in range(2):
        for k in range(3):
            stamp = STAMPS[n] + (JITTER[k] if k == 1 else 0)
            save(bag / "net" / f"cam{k}" / f"{stamp}.png", np.full(SIZE[::-1], 10 * n + k, np.uint8))
    dataset = open_dataset(bag, masks="net")
    assert dataset.masks == bag / "net"
    assert [[int(m[0, 0]) for m in f.masks or ()] for f in dataset] == [[0, 1, 2], [10, 11, 12]]
    (bag / "net" / "cam2" / f"{STAMPS[1]}.png").unlink()
    with pytest.raises(DatasetError, match=rf"cam2/{STAMPS[1]}.png: missing, as are the masks of 1 of 2 frames"):
        open_dataset(bag, masks="net")


def test_frames_without_a_mask_message_are_dropped(tmp_path: Path) -> None:
    topics = {topic(k): shots(k) for k in range(3)}
    for k in range(3):
        grey = [Shot(s.stamp + MS, np.full(SIZE[::-1], n, np.uint8), "mono8") for n, s in enumerate(topics[topic(k)])]
        topics[f"/m{k}"] = grey if k != 1 else grey[2:]
        topics[f"/late{k}"] = [Shot(s.stamp + 10 * MS, s.image, s.encoding) for s in grey]
    bag = make(tmp_path / "r", "rosbag1", topics)
    dataset = open_dataset(bag, masks="topics:/m0,/m1,/m2")
    assert [frame.masks[1][0, 0] for frame in dataset if frame.masks] == [2, 3, 4, 5]
    assert [str(d) for d in dataset.dropped] == ["6 images: 2 frames lack a mask of cam1 within 5 ms"]
    with pytest.raises(DatasetError, match="no frame has masks within 5 ms of its images"):
        open_dataset(bag, masks="topics:/late0,/late1,/late2")


def test_headers_without_time_stamps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    topics = {topic(k): [Shot(0, picture(k, n), delay=STAMPS[n]) for n in range(3)] for k in range(3)}
    with caplog.at_level(logging.WARNING, "seepast"):
        dataset = open_dataset(make(tmp_path / "r", "sqlite3", topics), masks="none")
    assert "headers have no time stamps" in caplog.text
    assert list(dataset.stamps) == [str(stamp) for stamp in STAMPS[:3]]
    np.testing.assert_array_equal(dataset.frame(str(STAMPS[2])).images[1], picture(1, 2))


def test_repeated_images_are_left_out(tmp_path: Path) -> None:
    topics = {topic(k): shots(k) for k in range(3)}
    topics[topic(0)].append(Shot(STAMPS[0], picture(9, 9), delay=PERIOD))
    dataset = open_dataset(make(tmp_path / "r", "mcap", topics), masks="none")
    assert [str(d) for d in dataset.dropped] == ["1 image: /cam0/image_raw has another image with the same time stamp"]
    np.testing.assert_array_equal(dataset.frame(str(STAMPS[0])).images[0], picture(0, 0))


def test_no_common_instant_and_a_larger_tolerance(tmp_path: Path) -> None:
    topics = {topic(k): [Shot(s + 8 * MS * k, picture(k, n)) for n, s in enumerate(STAMPS)] for k in range(3)}
    bag = make(tmp_path / "r", "mcap", topics)
    with pytest.raises(DatasetError, match=r"within 5 ms; nearest images are 0\.016 s apart"):
        open_dataset(bag, masks="none")
    assert len(open_dataset(bag, masks="none", tolerance=0.05).stamps) == len(STAMPS)


def test_which_paths_are_bags(tmp_path: Path) -> None:
    topics = {topic(k): shots(k) for k in range(3)}
    one = make(tmp_path / "one", "sqlite3", topics).parent
    assert find_datasets(one) == [one] and len(open_dataset(one, masks="none").stamps) == len(STAMPS)
    several = make(tmp_path / "several", "rosbag1", topics).parent
    write_bag(several / "later.bag", "rosbag1", topics)
    assert find_datasets(several) == [several / "later.bag", several / "walk.bag"]
    with pytest.raises(DatasetError, match=r"holds 2 recordings; name one of later\.bag, walk\.bag"):
        open_dataset(several)
    storage = next((one / "walk").glob("*.db3"))
    assert len(open_dataset(shutil.copy(storage, several / "copied.db3"), masks="none").stamps) == len(STAMPS)


def test_a_split_bag_is_read_as_one(tmp_path: Path) -> None:
    halves = [{topic(k): shots(k, frames) for k in range(3)} for frames in (range(3), range(3, 6))]
    folder = make(tmp_path / "r", "rosbag1", halves[0]).parent
    write_bag(folder / "walk_1.bag", "rosbag1", halves[1])
    dataset = open_dataset(folder, masks="none", reader="rosbag-split")
    assert list(dataset.stamps) == [str(stamp) for stamp in STAMPS]
    for n, frame in enumerate(dataset):
        np.testing.assert_array_equal(frame.images[2], picture(2, n))


def test_reading_goes_forward_without_seeking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    topics = {topic(k): shots(k) for k in range(3)}
    dataset = open_dataset(make(tmp_path / "r", "rosbag1", topics), masks="none")
    sought: list[int | None] = []
    messages = BagFile.messages
    monkeypatch.setattr(BagFile, "messages", lambda *a: (sought.append(a[2] if len(a) > 2 else None), messages(*a))[1])
    for n, frame in enumerate(dataset):
        np.testing.assert_array_equal(frame.images[1], picture(1, n))
    assert len(sought) == 1
    dataset.frame(str(STAMPS[1]))
    dataset.frame(str(STAMPS[1]))
    dataset.frame(str(STAMPS[4]))
    assert len(sought) == 2, "only to go back"


def test_images_recorded_late_or_in_another_order_are_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    delays = rng.integers(0, 6 * PERIOD, (3, 6))
    topics = {
        topic(k): [Shot(s.stamp, s.image, delay=int(d)) for s, d in zip(shots(k), delays[k], strict=True)]
        for k in range(3)
    }
    for kind in KINDS:
        dataset = open_dataset(make(tmp_path / kind, kind, topics), masks="none")
        for n in (0, 1, 2, 3, 4, 5, 2, 0):
            for k, image in enumerate(dataset.frame(str(STAMPS[n])).images):
                np.testing.assert_array_equal(image, picture(k, n))


def test_storage_files_that_overlap_in_time(tmp_path: Path) -> None:
    """rosbags reads the files of a ROS 2 bag one after the other: the second begins before the first ends."""
    bag = make(tmp_path / "r", "mcap", {topic(k): shots(k) for k in (0, 1)})
    other = write_bag(tmp_path / "other", "mcap", {topic(2): shots(2)})
    shutil.copy(next(other.glob("*.mcap")), bag / "other.mcap")
    merged, second = (yaml.safe_load((folder / "metadata.yaml").read_text()) for folder in (bag, other))
    ours, theirs = (m["rosbag2_bagfile_information"] for m in (merged, second))
    ours["relative_file_paths"].append("other.mcap")
    ours["topics_with_message_count"] += theirs["topics_with_message_count"]
    ours["message_count"] += theirs["message_count"]
    (bag / "metadata.yaml").write_text(yaml.safe_dump(merged))
    dataset = open_dataset(bag, masks="none")
    assert list(dataset.stamps) == [str(stamp) for stamp in STAMPS]
    for n, frame in enumerate(dataset):
        for k in range(3):
            np.testing.assert_array_equal(frame.images[k], picture(k, n))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_closed_with_its_dataset(kind: str, tmp_path: Path) -> None:
    dataset = open_dataset(make(tmp_path / "r", kind, {topic(k): shots(k) for k in range(3)}), masks="none")
    assert isinstance(dataset, RosbagDataset)
    dataset.frame(str(STAMPS[1]))  # reading stopped midway
    closed = dataset._bag.close
    del dataset
    assert not closed.alive


@pytest.mark.parametrize("kind", ["rosbag1-lz4", "rosbag1-bz2", "sqlite3-zstd", "mcap-zstd"])
def test_compressed_bags(kind: str, tmp_path: Path) -> None:
    format_, _, compression = kind.partition("-")
    topics = {topic(k): shots(k) for k in range(3)}
    make(tmp_path / "r", format_, topics)
    name = "packed.bag" if format_ == "rosbag1" else "packed"
    bag = write_bag(tmp_path / "r" / name, format_, topics, compression)
    frames = list(open_dataset(bag, masks="none"))
    assert len(frames) == len(STAMPS)
    np.testing.assert_array_equal(frames[3].images[2], picture(2, 3))


def test_without_rosbags_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = make(tmp_path / "r", "rosbag1", {topic(k): shots(k) for k in range(3)})
    monkeypatch.setitem(__import__("sys").modules, "rosbags", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'seepast\[rosbag\]'"):
        open_dataset(bag, masks="none")
