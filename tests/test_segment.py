"""Masks from networks: feeding, reading and classes of every preset, on tiny networks that compute known functions."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest

import onnx_nets as nets
from seepast.errors import MissingExtraError, ModelError, OptionsError
from seepast.segment import PRESETS, OnnxSegmenter, classes, open_segmenter
from seepast.segment.decode import MOST, Detections, distinct
from seepast.segment.prepare import Preparation
from seepast.segment.presets import Signature, Tensor, guess_preset

WEIGHTS = (0.6, 0.3, 0.1)  # of red, green, blue: no two alike, so that a swap shows
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
PERSON, CAR = 15, 7  # in Pascal VOC


def picture(size: tuple[int, int] = (97, 61), seed: int = 0) -> np.ndarray:
    """uint8 [h, w, 3], smooth, of all colours."""
    noise = np.random.default_rng(seed).random((5, 7, 3), np.float32)
    return np.clip(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC) * 255, 0, 255).astype(np.uint8)


def rectangle(size: tuple[int, int], box: tuple[int, int, int, int], colour: tuple[int, int, int]) -> np.ndarray:
    """Black but for the pixels x1 <= x < x2, y1 <= y < y2; colour is BGR."""
    image = np.zeros((size[1], size[0], 3), np.uint8)
    x1, y1, x2, y2 = box
    image[y1:y2, x1:x2] = colour
    return image


def inside(size: tuple[int, int], box: tuple[int, int, int, int]) -> np.ndarray:
    return rectangle(size, box, (255, 255, 255))[..., 0] > 0


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a.astype(int) - b).max() <= 1)


def classes_net(path: Path, numbers: dict[int, tuple[float, float, float]], count: int = 21, **more) -> Path:
    """Logits of class c = numbers[c] . (r, g, b), of all other classes 0."""
    weights = np.zeros((count, 3), np.float32)
    for number, row in numbers.items():
        weights[number] = row
    return nets.logits(path, weights, **more)


# ------------------------------------------------------------------------------------------ P(person)
def test_selfie_is_rgb_in_0_to_1_stretched_and_back_bilinearly(tmp_path: Path) -> None:
    image = picture()
    segment = OnnxSegmenter(nets.selfie(tmp_path / "net.onnx", WEIGHTS))
    seen = cv2.resize(image, (256, 144), interpolation=cv2.INTER_LINEAR).astype(float)
    expected = 255 * cv2.resize(seen[..., ::-1] / 255 @ np.array(WEIGHTS), (97, 61), interpolation=cv2.INTER_LINEAR)
    (mask,) = segment([image])
    assert segment.preset_name == "selfie" and mask.dtype == np.uint8 and mask.shape == image.shape[:2]
    assert np.abs(mask - expected).max() <= 0.51


def test_grey_images_are_fed_as_colour(tmp_path: Path) -> None:
    image = picture()[..., 0]
    (mask,) = OnnxSegmenter(nets.selfie(tmp_path / "net.onnx", WEIGHTS))([image])
    assert np.abs(mask.astype(int) - image).mean() < 3  # the weights add up to 1


def test_cameras_may_have_different_sizes(tmp_path: Path) -> None:
    masks = OnnxSegmenter(nets.selfie(tmp_path / "net.onnx", WEIGHTS))([picture((97, 61)), picture((64, 48))])
    assert [mask.shape for mask in masks] == [(61, 97), (48, 64)]


@pytest.mark.parametrize("softmax", [False, True])
def test_pphumanseg_is_rgb_in_minus_1_to_1_with_one_softmax(tmp_path: Path, softmax: bool) -> None:
    weights = 3 * np.array([(0, 0, 0), WEIGHTS], np.float32)
    segment = OnnxSegmenter(nets.logits(tmp_path / "net.onnx", weights, (192, 192), batch=1, softmax=softmax))
    image = np.full((40, 50, 3), (30, 200, 250), np.uint8)
    logit = 3 * np.dot(WEIGHTS, image[0, 0, ::-1] / 127.5 - 1)
    (mask,) = segment([image])
    assert segment.preset_name == "pphumanseg"
    assert np.abs(mask - 255 / (1 + np.exp(-logit))).max() <= 0.51


def test_people_is_normalised_as_imagenet(tmp_path: Path) -> None:
    net = nets.logits(tmp_path / "net.onnx", np.array([WEIGHTS]), (32, 32), bias=np.array([0.3]))
    image = np.full((20, 24, 3), (110, 140, 150), np.uint8)
    expected = np.dot(WEIGHTS, (image[0, 0, ::-1] / 255 - MEAN) / STD) + 0.3
    (mask,) = OnnxSegmenter(net, "people")([image])
    assert 0.1 < expected < 0.9 and np.abs(mask - 255 * expected).max() <= 0.51


def test_what_is_no_probability_is_refused(tmp_path: Path) -> None:
    net = nets.logits(tmp_path / "net.onnx", np.array([(5, 5, 5)]), (32, 32))
    with pytest.raises(ModelError, match=r"net.onnx: as 'people': .* no probability; export it with its sigmoid"):
        OnnxSegmenter(net, "people")([picture()])


def test_a_network_gone_astray_is_refused(tmp_path: Path) -> None:
    net = classes_net(tmp_path / "net.onnx", {PERSON: (float("nan"), 0, 0)}, size=(32, 32))
    with pytest.raises(ModelError, match="its output holds NaN or infinities"):
        OnnxSegmenter(net)([picture()])


def test_classes_make_no_sense_for_a_network_that_knows_people_only(tmp_path: Path) -> None:
    net = nets.selfie(tmp_path / "net.onnx", WEIGHTS)
    assert OnnxSegmenter(net, classes=["person"]).preset_name == "selfie"
    with pytest.raises(OptionsError, match="knows people only"):
        OnnxSegmenter(net, classes=["car"])


# -------------------------------------------------------------------------------------- class logits
@pytest.mark.parametrize(
    ("wanted", "numbers"), [(None, [15]), (["person", "car"], [7, 15]), (["7"], [7]), (["TV_Monitor", "15"], [15, 20])]
)
def test_deeplab_sums_the_softmax_of_the_chosen_classes(tmp_path: Path, wanted, numbers) -> None:
    rows = {PERSON: (1.5, 0, 0), CAR: (0, 1.2, 0), 20: (0, 0, 1.7)}
    segment = OnnxSegmenter(classes_net(tmp_path / "net.onnx", rows), None, wanted)
    image = np.full((40, 50, 3), (200, 180, 220), np.uint8)
    logits = np.zeros(21)
    for number, row in rows.items():
        logits[number] = np.dot(row, (image[0, 0, ::-1] / 255 - MEAN) / STD)
    expected = 255 * np.exp(logits)[numbers].sum() / np.exp(logits).sum()
    (mask,) = segment([image])
    assert segment.preset_name == "deeplab"
    assert np.abs(mask - expected).max() <= 0.51


def test_the_output_out_is_read_not_the_one_for_training(tmp_path: Path) -> None:
    rows = {PERSON: (9.0, 0, 0)}
    plain = OnnxSegmenter(classes_net(tmp_path / "a.onnx", rows))([picture()])
    beside = OnnxSegmenter(classes_net(tmp_path / "b.onnx", rows, also="aux"))([picture()])
    assert np.array_equal(plain[0], beside[0])


def test_segformer_comes_back_from_a_quarter_without_a_shift(tmp_path: Path) -> None:
    net = classes_net(tmp_path / "net.onnx", {11: (2, 2, 2)}, 19, size=(64, 128), pool=4)
    segment = OnnxSegmenter(net)
    assert segment.preset_name == "segformer"
    size, box = (64, 48), (24, 12, 40, 36)  # in the middle; edges that fall on cells of the output
    (mask,) = segment([rectangle(size, box, (255, 255, 255))])
    (dark,), (bright,) = segment([np.zeros((48, 64, 3), np.uint8)]), segment([np.full((48, 64, 3), 255, np.uint8)])
    middle = (int(dark[0, 0]) + int(bright[0, 0])) / 2
    assert iou(mask > middle, inside(size, box)) > 0.98  # corners are rounded
    assert same(mask, mask[::-1, ::-1])  # a shift would show in the middle of the image


def test_a_model_that_says_nothing_about_its_shape_is_tried_out(tmp_path: Path) -> None:
    net = classes_net(tmp_path / "net.onnx", {12: (5, 0, 0)}, 150, size=("h", "w"), declare=False, pool=16)
    red, blue = np.full((40, 50, 3), (0, 0, 255), np.uint8), np.full((40, 50, 3), (255, 0, 0), np.uint8)
    for segment in (OnnxSegmenter(net), OnnxSegmenter(net, "segformer")):
        assert segment.preset_name == "segformer"
        masks = segment([red, blue])  # person is 12 in ADE20K
        assert masks[0].min() > 250 and masks[1].max() < 5
    with pytest.raises(OptionsError, match="no such class; it has person"):
        OnnxSegmenter(net, None, ["persom"])
    with pytest.raises(OptionsError, match="no such class; it has person"):
        OnnxSegmenter(net, "segformer", ["persom"])([red])


def test_what_no_preset_fits_is_refused_with_a_list(tmp_path: Path) -> None:
    net = nets.logits(tmp_path / "net.onnx", np.eye(7, 3), ("h", "w"), declare=False)
    said = r"net.onnx: its shapes do not tell .* out \[None, 7, 512, 512\].* onnx:MODEL.onnx:segformer.*yolo-e2e"
    with pytest.raises(ModelError, match=said):
        OnnxSegmenter(net)


def test_labels_of_a_tensorflow_deeplab(tmp_path: Path) -> None:
    segment = OnnxSegmenter(nets.labels_last(tmp_path / "net.onnx", (48, 64)), "deeplab-tf", [str(PERSON)])
    image = rectangle((64, 48), (10, 5, 30, 40), (90, 100, 200))
    image[image.sum(axis=2) == 0] = (200, 100, 50)
    assert np.array_equal(segment([image])[0] > 127, inside((64, 48), (10, 5, 30, 40)))


def test_labels_of_an_argmax_in_the_network(tmp_path: Path) -> None:
    net = classes_net(tmp_path / "net.onnx", {3: (1, 0, 0), 4: (0, 1, 0)}, 5, argmax=True, size=(32, 32))
    image = np.full((32, 32, 3), (0, 0, 255), np.uint8)
    assert OnnxSegmenter(net, "deeplab", ["3"])([image])[0].min() == 255
    assert OnnxSegmenter(net, "deeplab", ["4"])([image])[0].max() == 0


def test_half_precision_goes_in_and_out(tmp_path: Path) -> None:
    rows = {PERSON: (2.0, 0, 0)}
    full = OnnxSegmenter(classes_net(tmp_path / "a.onnx", rows))([picture()])
    half = OnnxSegmenter(classes_net(tmp_path / "b.onnx", rows, dtype=nets.HALF))([picture()])
    assert np.abs(full[0].astype(int) - half[0]).max() <= 2


# -------------------------------------------------------------------------------------------- batches
@pytest.mark.parametrize(("batch", "runs"), [("n", [3]), (1, [1, 1, 1]), (2, [2, 2])])
def test_all_views_go_in_one_batch_where_the_model_allows_it(tmp_path: Path, monkeypatch, batch, runs) -> None:
    images = [picture(seed=k) for k in range(3)]
    segment = OnnxSegmenter(classes_net(tmp_path / "net.onnx", {PERSON: (2, 1, 0)}, batch=batch))
    one_by_one = [segment([image])[0] for image in images]
    seen = []
    run = segment.model.run
    monkeypatch.setattr(segment.model, "run", lambda values: seen.append(len(values)) or run(values))
    masks = segment(images)
    assert seen == runs
    assert not np.array_equal(masks[0], masks[1])
    assert all(np.array_equal(mask, alone) for mask, alone in zip(masks, one_by_one, strict=True))


def test_a_model_that_only_pretends_to_take_batches(tmp_path: Path, caplog) -> None:
    net = nets.pretender(tmp_path / "net.onnx", (32, 32))
    segment = OnnxSegmenter(net, "selfie")
    images = [np.full((20, 24, 3), grey, np.uint8) for grey in (0, 102, 255)]
    for _ in range(2):
        assert [int(mask.mean()) for mask in segment(images)] == [0, 102, 255]
    assert caplog.text.count("takes images only one by one, though its shapes say otherwise") == 1


# ------------------------------------------------------------------------------------------ instances
def test_mask_rcnn_of_the_zoo_is_pasted_into_its_boxes(tmp_path: Path) -> None:
    size = (60, 40)  # goes in 20 times as large, 1200x800, and padded to 1216x800
    masks = np.zeros((4, 1, 28, 28), np.float32)
    masks[0, 0, :, :14] = 0.8  # a person's left half
    masks[1:] = 1.0
    boxes = 20 * np.array([(10, 8, 38, 36), (40, 10, 50, 20), (2, 2, 8, 8), (50.4, 30.4, 58.4, 38.4)])
    net = nets.mask_rcnn(tmp_path / "net.onnx", boxes, [1, 3, 1, 1], [0.9, 0.9, 0.4, 0.95], masks)
    segment = OnnxSegmenter(net)
    (mask,) = segment([picture(size)])
    assert segment.preset_name == "maskrcnn-zoo"
    expected = inside(size, (10, 8, 24, 36)) | inside(size, (50, 30, 58, 38))  # 3 is a car, 0.4 too little
    assert iou(mask > 100, expected) == 1
    assert abs(int(mask[20, 15]) - 204) <= 1 and mask[33, 54] == 255
    (cars,) = OnnxSegmenter(net, None, ["car"])([picture(size)])
    assert iou(cars > 127, inside(size, (40, 10, 50, 20))) == 1


def test_mask_rcnn_of_the_zoo_is_fed_bgr_minus_mean_padded_with_zeros() -> None:
    values, placement = PRESETS["maskrcnn-zoo"].preparation(np.full((40, 60, 3), (110, 120, 130), np.uint8), None)
    assert values.shape == (800, 1216, 3) and placement.scale == (20, 20)
    assert np.allclose(values[:, :1200], np.array((110, 120, 130)) - (102.9801, 115.9465, 122.7717), atol=1e-4)
    assert (values[:, 1200:] == 0).all()


def test_mask_rcnn_of_torchvision_has_masks_of_the_whole_image(tmp_path: Path) -> None:
    net = nets.mask_rcnn_whole(tmp_path / "net.onnx", np.array([(5, 3, 25, 17)]), [1], [0.9])
    segment = OnnxSegmenter(net)
    image = picture((40, 30))
    (mask,) = segment([image])
    assert segment.preset_name == "maskrcnn" and same(mask, image[..., 2])
    assert OnnxSegmenter(net, None, ["bicycle"])([image])[0].max() == 0


def test_boxes_that_are_no_boxes_are_left_out(tmp_path: Path) -> None:
    boxes = np.array([(np.nan, 0, 20, 20), (30, 30, 10, 10), (-1e6, -1e6, -1e5, -1e5), (0, 0, 0, 0)])
    net = nets.mask_rcnn(tmp_path / "n.onnx", boxes, [1] * 4, [0.9] * 4, np.ones((4, 1, 28, 28), np.float32))
    assert OnnxSegmenter(net)([picture()])[0].max() == 0


def test_a_network_that_sees_nothing_leaves_nothing_dynamic(tmp_path: Path) -> None:
    net = nets.mask_rcnn(tmp_path / "n.onnx", np.zeros((0, 4)), [], [], np.zeros((0, 1, 28, 28), np.float32))
    assert OnnxSegmenter(net)([picture()])[0].max() == 0


BOX = (30, 18, 66, 54)  # of a 96x72 image, which a YOLO net of 64x64 sees as 64x48 below 8 rows of grey
FOUND = (21, 9, 75, 63)  # the box that is found around it
SEEN = (14.0, 14.0, 50.0, 50.0)  # the same in the input: 2/3 of it, and 8 down
CENTRE = (32.0, 32.0, 36.0, 36.0)


def yolo_rows(form: str) -> np.ndarray:
    """Person, the same again, something else, and a weak one whose mask is all that the person's is not."""
    if form == "yolo-e2e":
        return np.array([(*SEEN, 0.9, 0, 1, 0), (*SEEN, 0.8, 1, 0, 1), (0, 0, 64, 64, 0.1, 0, -1, 0)])
    rows = [
        (*CENTRE, 0.9, 0.1, 1, 0), (*CENTRE[:3], 34.0, 0.7, 0.1, 1, 0), (*CENTRE, 0.05, 0.8, 0, 1),
        (32, 32, 64, 64, 0.1, 0.1, -1, 0),
    ]  # fmt: skip
    if form == "yolov5":  # the weak one is a person for sure, if it is anything
        return np.array([(*row[:4], 1.0, *row[4:]) for row in rows[:3]] + [(32, 32, 64, 64, 0.1, 1.0, 0, -1, 0)])
    return np.array(rows + [(0,) * 8] * 8).T


@pytest.mark.parametrize("form", ["yolo", "yolov5", "yolo-e2e"])
def test_yolo_finds_the_rectangle_through_its_letterbox(tmp_path: Path, form: str) -> None:
    net = nets.yolo(tmp_path / "net.onnx", yolo_rows(form), metadata={"names": "{0: 'person', 1: 'Red Kite'}"})
    image = rectangle((96, 72), BOX, (0, 0, 255))
    segment = OnnxSegmenter(net, None if form != "yolov5" else form)
    (mask,) = segment([image])
    assert segment.preset_name == form
    assert iou(mask > 127, inside((96, 72), BOX)) > 0.98 and same(mask, mask[::-1, ::-1])
    assert mask[0, 0] == 0  # the weak one's box is the whole image
    (kite,) = OnnxSegmenter(net, form, ["red kite"])([image])
    assert kite.max() == 0  # its prototype is green
    image[..., 1] = image[..., 2]
    assert iou(OnnxSegmenter(net, form, ["1"])([image])[0] > 127, inside((96, 72), BOX)) > 0.98


def test_yolo_masks_end_at_their_box(tmp_path: Path) -> None:
    net = nets.yolo(tmp_path / "net.onnx", yolo_rows("yolo"), metadata={"names": "['person', 'kite']"})
    (mask,) = OnnxSegmenter(net)([np.full((72, 96, 3), (0, 0, 255), np.uint8)])
    assert np.array_equal(mask > 127, inside((96, 72), FOUND))


@pytest.mark.parametrize("metadata", [None, {"names": "{0: '0', 1: '1'}"}, {"names": "what"}, {"names": "3"}])
def test_yolo_without_names_takes_numbers_only(tmp_path: Path, metadata: dict[str, str] | None) -> None:
    net = nets.yolo(tmp_path / "net.onnx", yolo_rows("yolo"), metadata=metadata)
    with pytest.raises(OptionsError, match="give their numbers; the network has 2 classes, numbered 0 to 1"):
        OnnxSegmenter(net)
    with pytest.raises(OptionsError, match="--classes 2: the network's classes are numbered 0 to 1"):
        OnnxSegmenter(net, None, ["2"])
    assert OnnxSegmenter(net, None, ["0"])([rectangle((96, 72), BOX, (0, 0, 255))])[0].max() == 255


def test_yolo_is_fed_rgb_in_0_to_1_between_grey() -> None:
    values, placement = PRESETS["yolo"].preparation(np.full((72, 96, 3), (51, 102, 204), np.uint8), (64, 64))
    assert placement.scale == (64 / 96, 48 / 72) and placement.offset == (0, 8)
    assert np.allclose(values[8:56], (0.8, 0.4, 0.2)) and np.allclose(values[:8], 114 / 255)
    assert np.allclose(values[56:], 114 / 255)


def test_overlapping_boxes_of_one_class_are_one_object() -> None:
    boxes = np.array([(0, 0, 10, 10), (0, 1, 10, 10), (0, 0, 10, 10), (0, 6, 10, 16), (0, 0, 10, 10)], float)
    found = Detections(boxes, np.array([0, 0, 1, 0, 0]), np.array([0.5, 0.9, 0.8, 0.7, 0.01]), np.arange(5))
    assert distinct(found).masks.tolist() == [1, 2, 3]
    crowd = 20.0 * np.arange(MOST + 9)[:, None] + np.array((0, 0, 10, 10))
    scores = np.linspace(0.1, 0.9, len(crowd))
    kept = distinct(Detections(crowd, np.zeros(len(crowd), int), scores, np.arange(len(crowd)))).masks
    assert kept.tolist() == list(range(len(crowd) - 1, 8, -1))  # the best


# ------------------------------------------------------------------------- presets of networks as people have them
@pytest.mark.parametrize(
    ("taken", "given", "preset"),
    [
        ((1, 256, 256, 3), [(1, 256, 256, 1)], "selfie"),
        ((1, 3, 192, 192), [(1, 2, 192, 192)], "pphumanseg"),
        ((None, 3, 520, 520), [(None, 21, 520, 520), (None, 21, 520, 520)], "deeplab"),
        ((None, 3, None, None), [(None, 21, None, None)], "deeplab"),
        ((1, 257, 257, 3), [(1, 257, 257, 21)], "deeplab-tf"),
        ((None, 3, 512, 512), [(None, 150, 128, 128)], "segformer"),
        ((1, 3, 1024, 1024), [(1, 19, 256, 256)], "segformer"),
        ((3, None, None), [(None, 4), (None,), (None,), (None, 1, None, None)], "maskrcnn"),
        ((3, None, None), [(None, 4), (None,), (None,), (None, 1, 28, 28)], "maskrcnn-zoo"),
        ((1, 3, 640, 640), [(1, 116, 8400), (1, 32, 160, 160)], "yolo"),
        ((1, 3, 640, 640), [(1, 25200, 117), (1, 32, 160, 160)], "yolov5"),
        ((1, 3, 640, 640), [(1, 300, 38), (1, 32, 160, 160)], "yolo-e2e"),
        ((1, 3, 640, 640), [(1, 84, 8400)], None),  # YOLO without segments
        ((1, 3, 320, 320), [(1, 1, 320, 320)], None),  # could be normalised in many ways
        ((1, 3, 224, 224), [(1, 1000)], None),
    ],
)
def test_the_preset_is_guessed_where_the_shapes_allow_one_only(taken, given, preset) -> None:
    outputs = tuple(Tensor(f"o{i}", shape, "float32") for i, shape in enumerate(given))
    signature = Signature(Tensor("image", taken, "float32"), outputs)
    if preset is not None:
        assert guess_preset(signature) == preset
    else:
        with pytest.raises(ModelError, match="its shapes do not tell what kind of network it is"):
            guess_preset(signature)


# ------------------------------------------------------------------------------------ classes by name
def test_the_tables_have_the_data_sets_own_numbers() -> None:
    assert (classes.COCO[0], classes.COCO[2], classes.COCO[79]) == ("person", "car", "toothbrush")
    assert (classes.COCO_CATEGORIES[1], classes.COCO_CATEGORIES[13], classes.COCO_CATEGORIES[90]) == (
        "person", "stop sign", "toothbrush")  # fmt: skip
    assert (classes.COCO_AFTER_BACKGROUND[1], classes.COCO_AFTER_BACKGROUND[80]) == ("person", "toothbrush")
    assert (classes.VOC[15], classes.VOC[20], classes.CITYSCAPES[11], classes.CITYSCAPES[18]) == (
        "person", "tv monitor", "person", "bicycle")  # fmt: skip
    assert (classes.ADE[12], classes.ADE[20], classes.ADE[149]) == ("person", "car", "flag")
    for count, table in classes.BY_COUNT.items():
        assert max(table) == count - 1 and "person" in table.values()


# ---------------------------------------------------------------------------------- what can go wrong
def test_a_file_that_is_not_there_or_no_network(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"nothing.onnx: no such file"):
        open_segmenter(f"onnx:{tmp_path / 'nothing.onnx'}")
    (tmp_path / "broken.onnx").write_bytes(b"not a network")
    with pytest.raises(ModelError, match=r"broken.onnx: onnxruntime cannot load it .* fetch it again"):
        open_segmenter(f"onnx:{tmp_path / 'broken.onnx'}")


def test_a_preset_that_is_unknown_or_does_not_fit(tmp_path: Path) -> None:
    net = nets.selfie(tmp_path / "net.onnx", WEIGHTS)
    with pytest.raises(ModelError, match=r"net.onnx: no preset 'selfy'; there are selfie .*maskrcnn"):
        open_segmenter(f"onnx:{net}:selfy")
    with pytest.raises(ModelError, match=r"net.onnx: as 'yolo': it has no output of 3 axes"):
        open_segmenter(f"onnx:{net}:yolo", ["0"])([picture()])
    with pytest.raises(ModelError, match=r"net.onnx: as 'maskrcnn': its outputs are float32 \[1, 144, 256, 1\]"):
        open_segmenter(f"onnx:{net}:maskrcnn")([picture()])


def test_without_onnxruntime_the_extra_is_named(tmp_path: Path, monkeypatch) -> None:
    net = nets.selfie(tmp_path / "net.onnx", WEIGHTS)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'seepast\[onnx\]'"):
        open_segmenter(f"onnx:{net}")


def test_it_describes_itself_by_the_hash_of_its_model(tmp_path: Path) -> None:
    net = classes_net(tmp_path / "net.onnx", {PERSON: (1, 0, 0)})
    said = open_segmenter(f"onnx:{net}:deeplab", ["person", "7"]).describe()
    assert said == {
        "kind": "onnx", "model": str(net.resolve()), "sha256": hashlib.sha256(net.read_bytes()).hexdigest(),
        "preset": "deeplab", "provider": "CPU", "classes": ["person", "7"],
    }  # fmt: skip


def test_weights_in_a_file_beside_it_count_too(tmp_path: Path) -> None:
    path = nets.selfie(tmp_path / "net.onnx", WEIGHTS)
    before = open_segmenter(f"onnx:{path}")([picture()])
    onnx.save_model(onnx.load(path), path, save_as_external_data=True, location="net.onnx.data", size_threshold=0)
    segment = open_segmenter(f"onnx:{path}")
    data = tmp_path / "net.onnx.data"
    assert segment.describe()["data_sha256"] == hashlib.sha256(data.read_bytes()).hexdigest()
    assert np.array_equal(before, segment([picture()]))


@pytest.mark.parametrize(
    ("there", "wanted"),
    [
        (["AzureExecutionProvider", "CPUExecutionProvider"], ["CPU"]),
        (["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"], ["CUDA", "CPU"]),
        (["CPUExecutionProvider", "CoreMLExecutionProvider"], ["CoreML", "CPU"]),
    ],
)
def test_the_best_processor_that_is_there_runs_it(tmp_path: Path, monkeypatch, caplog, there, wanted) -> None:
    asked: list[list[str]] = []
    session = onnxruntime.InferenceSession

    def opened(path: str, options: object, providers: list[str]) -> object:
        asked.append(providers)
        return session(path, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: there)
    monkeypatch.setattr(onnxruntime, "InferenceSession", opened)
    monkeypatch.setattr(onnxruntime, "preload_dlls", lambda: asked.append(["preloaded"]), raising=False)
    OnnxSegmenter(nets.selfie(tmp_path / "net.onnx", WEIGHTS))
    assert asked[-1] == [f"{name}ExecutionProvider" for name in wanted]
    assert (["preloaded"] in asked) == ("CUDA" in wanted)
    assert ("does not start; CPUExecutionProvider runs it" in caplog.text) == (len(wanted) > 1)


def test_letterboxes_of_odd_sizes_keep_the_middle() -> None:
    values, placement = Preparation(fit="letterbox")(picture((101, 33)), (64, 64))
    assert values.shape == (64, 64, 3) and placement.offset == (0, 21) and placement.scale == (64 / 101, 21 / 33)
