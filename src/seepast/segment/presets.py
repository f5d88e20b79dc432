"""What is known about networks by the shape of their output: how to feed them, how to read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..errors import ModelError
from .classes import COCO, COCO_AFTER_BACKGROUND, COCO_CATEGORIES, Names
from .prepare import Preparation

Shape = tuple[int | None, ...]  # None: the model leaves this axis open
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HALF = (0.5, 0.5, 0.5)
IMAGENET = Preparation(mean=IMAGENET_MEAN, std=IMAGENET_STD, size=(512, 512))
YOLO = Preparation(fit="letterbox", size=(640, 640))


@dataclass(frozen=True)
class Tensor:
    """One input or output of a model. dtype: "float32", "float16", "uint8", "int64" ..."""

    name: str
    shape: Shape
    dtype: str


@dataclass(frozen=True)
class Signature:
    """What a model takes and gives. outputs in its own order."""

    input: Tensor
    outputs: tuple[Tensor, ...]

    @property
    def channels_last(self) -> bool:
        """Whether the image goes in as [..., h, w, 3]. Raises ModelError where no axis can hold three colours."""
        shape = self.input.shape
        if len(shape) not in (3, 4):
            raise ModelError(f"its input '{self.input.name}' has {len(shape)} axes, an image has 3 or 4")
        if shape[-3] == 3 or (shape[-3] is None and shape[-1] != 3):
            return False
        if shape[-1] == 3:
            return True
        raise ModelError(f"its input '{self.input.name}' is {shape}: three channels of colour are needed")

    @property
    def size(self) -> tuple[int, int] | None:
        """(width, height) of its input, None where it takes any."""
        height, width = self.input.shape[-3:-1] if self.channels_last else self.input.shape[-2:]
        return None if width is None or height is None else (width, height)

    @property
    def batch(self) -> int | None:
        """Images in one run; None: any number."""
        return 1 if len(self.input.shape) == 3 else self.input.shape[0]

    def completed(self, outputs: Sequence[Sequence[int]]) -> Signature:
        """With the shapes that outputs really had, where the model left them open; the batch and objects stay open."""
        known = [
            replace(
                tensor, shape=tensor.shape[:1] + tuple(n or m for n, m in zip(tensor.shape[1:], real[1:], strict=True))
            )
            if len(tensor.shape) == len(real)
            else replace(tensor, shape=(None, *real[1:]))
            for tensor, real in zip(self.outputs, outputs, strict=True)
        ]
        return replace(self, outputs=tuple(known))

    @property
    def main(self) -> int:
        """Index of the output "out", beside which torchvision's networks have one for training; else of the first."""
        names = [tensor.name for tensor in self.outputs]
        return names.index("out") if "out" in names else 0


@dataclass(frozen=True)
class Preset:
    """One kind of network.

    kind         "people": P(person), or background and person; "classes": logits, probabilities or labels;
                 "instances": boxes, labels, scores, masks; "prototypes": rows and prototypes
    preparation  how an image becomes its input
    names        what its labels mean; None: as its metadata or the number of its classes says
    rows         how a "prototypes" network lists objects: a name in decode.ROWS
    least        score below which an object is not there
    """

    about: str
    kind: str
    preparation: Preparation
    names: Names | None = None
    rows: str = ""
    least: float = 0.5


PRESETS: dict[str, Preset] = {
    "selfie": Preset("MediaPipe selfie: P(person), RGB in 0..1", "people", Preparation(size=(256, 144))),
    "pphumanseg": Preset(
        "PP-HumanSeg: background and person, RGB in -1..1", "people", Preparation(mean=HALF, std=HALF, size=(192, 192))
    ),
    "people": Preset("P(person), RGB normalised as ImageNet", "people", IMAGENET),
    "deeplab": Preset("DeepLab, FCN of torchvision: class logits, RGB normalised as ImageNet", "classes", IMAGENET),
    "deeplab-tf": Preset(
        "DeepLab of TensorFlow: class logits or labels, RGB in -1..1",
        "classes",
        Preparation(mean=HALF, std=HALF, size=(513, 513)),
    ),
    "segformer": Preset("SegFormer: class logits, RGB normalised as ImageNet", "classes", IMAGENET),
    "maskrcnn": Preset("Mask R-CNN of torchvision, RGB in 0..1", "instances", Preparation(fit="none"), COCO_CATEGORIES),
    "maskrcnn-zoo": Preset(
        "Mask R-CNN of the ONNX model zoo: BGR minus mean",
        "instances",
        Preparation("BGR", 1.0, (102.9801, 115.9465, 122.7717), fit="shorter", size=(1333, 800)),
        COCO_AFTER_BACKGROUND,
    ),
    "yolo": Preset("YOLOv8-seg, YOLO11-seg", "prototypes", YOLO, None, "yolo", 0.25),
    "yolov5": Preset("YOLOv5-seg", "prototypes", YOLO, None, "yolov5", 0.25),
    "yolo-e2e": Preset("YOLO26-seg, or exported with nms=True", "prototypes", YOLO, COCO, "yolo-e2e", 0.25),
}


HEADS = {"yolo": (4, 1), "yolov5": (5, 2)}  # numbers before the classes in a row, and the axis the rows' numbers lie on


def find_preset(name: str) -> Preset:
    """Raises ModelError, listing what there is."""
    if name not in PRESETS:
        raise ModelError(f"no preset '{name}'; there are {list_of_presets()}")
    return PRESETS[name]


def list_of_presets() -> str:
    return "; ".join(f"{name} ({preset.about})" for name, preset in PRESETS.items())


def guess_preset(signature: Signature) -> str:
    """The only preset that the shapes of inputs and outputs allow. Raises ModelError where there is no such."""
    found = _guess_objects(signature) or _guess_map(signature)
    if found is None:
        shapes = ", ".join(f"{t.name} {list(t.shape)}" for t in (signature.input, *signature.outputs))
        raise ModelError(
            f"its shapes do not tell what kind of network it is ({shapes}); add the preset, as in "
            f"onnx:MODEL.onnx:segformer: {list_of_presets()}"
        )
    return found


def _guess_objects(signature: Signature) -> str | None:
    ranks = sorted(len(t.shape) for t in signature.outputs)
    if ranks == [1, 1, 2, 4]:
        masks = next(t for t in signature.outputs if len(t.shape) == 4)
        return "maskrcnn-zoo" if masks.shape[-2:] == (28, 28) else "maskrcnn"
    if ranks[:1] != [3] or 4 not in ranks:
        return None
    rows = next(t.shape for t in signature.outputs if len(t.shape) == 3)
    weights = next(t.shape for t in signature.outputs if len(t.shape) == 4)[1]
    if weights is None or rows[1] is None or rows[2] is None:
        return None
    if rows[2] == 6 + weights and rows[1] <= 1000:
        return "yolo-e2e"
    return "yolo" if rows[1] < rows[2] else "yolov5"


def _guess_map(signature: Signature) -> str | None:
    shape, size = signature.outputs[signature.main].shape, signature.size
    if len(shape) != 4 or len(signature.input.shape) != 4:
        return None
    last = signature.channels_last
    channels = shape[-1] if last else shape[1]
    if channels == 1 and last and size in ((256, 144), (256, 256)):
        return "selfie"
    if 2 in (shape[1], shape[-1]) and size == (192, 192):
        return "pphumanseg"
    if channels == 21:
        return "deeplab-tf" if last else "deeplab"
    return "segformer" if channels in (19, 150) and not last else None
