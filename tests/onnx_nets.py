"""Tiny ONNX networks whose output is a known function of their input, one for each shape of output there is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

FLOAT, HALF, BYTE, INT64 = TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.UINT8, TensorProto.INT64
IN, OPSET, IR = "image", 13, 8


def save(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    shape: Sequence[int | str | None],
    outputs: dict[str, tuple[int, Sequence[int | str | None]]],
    *,
    constants: dict[str, np.ndarray] | None = None,
    dtype: int = FLOAT,
    metadata: dict[str, str] | None = None,
) -> Path:
    """One input "image" of `shape`; outputs: name -> (type, shape)."""
    graph = helper.make_graph(
        list(nodes),
        "net",
        [helper.make_tensor_value_info(IN, dtype, shape)],
        [helper.make_tensor_value_info(name, *what) for name, what in outputs.items()],
        [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    if metadata:
        helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def selfie(path: Path, weights: Sequence[float], size: tuple[int, int] = (144, 256)) -> Path:
    """P = weights . (r, g, b), channels last."""
    matrix = np.array(weights, np.float32)[:, None]
    nodes = [helper.make_node("MatMul", [IN, "w"], ["p"])]
    return save(path, nodes, (1, *size, 3), {"p": (FLOAT, (1, *size, 1))}, constants={"w": matrix})


def logits(
    path: Path,
    weights: np.ndarray,
    size: tuple[int | str, int | str] = (64, 64),
    *,
    batch: int | str = "n",
    pool: int = 1,
    softmax: bool = False,
    argmax: bool = False,
    dtype: int = FLOAT,
    bias: np.ndarray | None = None,
    declare: bool = True,
    metadata: dict[str, str] | None = None,
    also: str | None = None,
) -> Path:
    """float [n, C, h / pool, w / pool] = weights [C, 3] . mean (r, g, b) of pool x pool input pixels + bias.

    declare: say in the model how many classes there are; also: a second output of this name, listed first.
    """
    classes = len(weights)
    kind = np.float16 if dtype == HALF else np.float32
    nodes = [
        helper.make_node("AveragePool", [IN], ["pooled"], kernel_shape=[pool, pool], strides=[pool, pool]),
        helper.make_node("Conv", ["pooled", "w", "b"], ["conv"]),
        helper.make_node("Softmax", ["conv"], ["soft"], axis=1),
        helper.make_node("ArgMax", ["soft"], ["label"], axis=1, keepdims=0),
    ]
    constants = {
        "w": np.asarray(weights, kind)[:, :, None, None],
        "b": np.zeros(classes, kind) if bias is None else np.asarray(bias, kind),
    }
    small = tuple(n // pool if isinstance(n, int) else None for n in size)
    last = "label" if argmax else "soft" if softmax else "conv"
    if not declare:  # nor can it be told from the graph
        nodes.append(helper.make_node("Compress", [last, "all"], ["some"], axis=1))
        constants["all"], last = np.ones(classes, bool), "some"
    shape = (batch, *small) if argmax else (batch, classes if declare else "c", *small)
    nodes.append(helper.make_node("Identity", [last], ["out"]))
    outputs = {"out": (INT64 if argmax else dtype, shape)}
    if also:
        nodes.append(helper.make_node("Neg", [last], [also]))
        outputs = {also: outputs["out"], **outputs}
    return save(path, nodes, (batch, 3, *size), outputs, constants=constants, dtype=dtype, metadata=metadata)


def pretender(path: Path, size: tuple[int, int]) -> Path:
    """The red channel; the input says [n, 3, h, w], but inside all is shaped for one image, as exporters often do."""
    nodes = [
        helper.make_node("Reshape", [IN, "one"], ["single"]),
        helper.make_node("Conv", ["single", "w"], ["p"]),
    ]
    constants = {"one": np.array([1, 3, *size], np.int64), "w": np.eye(1, 3, dtype=np.float32)[:, :, None, None]}
    return save(path, nodes, ("n", 3, *size), {"p": (FLOAT, (1, 1, *size))}, constants=constants)


def labels_last(path: Path, size: tuple[int, int]) -> Path:
    """uint8 [1, h, w, 3] in; int64 [1, h, w] out: 15 where red is the strongest channel, else 0 (as DeepLab of TF)."""
    nodes = [
        helper.make_node("Cast", [IN], ["f"], to=FLOAT),
        helper.make_node("ArgMax", ["f"], ["strongest"], axis=3, keepdims=0),
        helper.make_node("Gather", ["table", "strongest"], ["labels"]),
    ]
    table = {"table": np.array([15, 0, 0], np.int64)}
    return save(path, nodes, (1, *size, 3), {"labels": (INT64, (1, *size))}, constants=table, dtype=BYTE)


def mask_rcnn(path: Path, boxes: np.ndarray, labels: Sequence[int], scores: Sequence[float], masks: np.ndarray) -> Path:
    """Says the same whatever it sees: masks [n, 1, m, m] over the boxes."""
    return _objects(path, boxes, labels, scores, {"masks": np.asarray(masks, np.float32)}, [], masks.shape[1:])


def mask_rcnn_whole(path: Path, boxes: np.ndarray, labels: Sequence[int], scores: Sequence[float]) -> Path:
    """Its only object's mask [1, 1, H, W] is the input's red channel."""
    nodes = [
        helper.make_node("Slice", [IN, "zero", "one", "zero"], ["red"]),
        helper.make_node("Unsqueeze", ["red", "zero"], ["masks"]),
    ]
    extra = {"zero": np.array([0], np.int64), "one": np.array([1], np.int64)}
    return _objects(path, boxes, labels, scores, extra, nodes, (1, None, None))


def _objects(path, boxes, labels, scores, extra, nodes, shape) -> Path:
    constants = {
        "boxes_": np.asarray(boxes, np.float32),
        "labels_": np.asarray(labels, np.int64),
        "scores_": np.asarray(scores, np.float32),
    }
    nodes = [*nodes, *(helper.make_node("Identity", [f"{n}_"], [n]) for n in ("boxes", "labels", "scores"))]
    if "masks" in extra:
        extra = {"masks_": extra["masks"]}
        nodes.append(helper.make_node("Identity", ["masks_"], ["masks"]))
    outputs = {
        "boxes": (FLOAT, (None, 4)), "labels": (INT64, (None,)), "scores": (FLOAT, (None,)),
        "masks": (FLOAT, (None, *shape)),
    }  # fmt: skip
    return save(path, nodes, (3, "height", "width"), outputs, constants={**constants, **extra})


def yolo(
    path: Path,
    rows: np.ndarray,
    *,
    size: tuple[int, int] = (64, 64),
    metadata: dict[str, str] | None = None,
    batch: int = 1,
) -> Path:
    """rows are the first output; the two prototypes are 40 (mean of 4x4 input pixels - 1/2) of red and of green."""
    height, width = size
    nodes = [
        helper.make_node("AveragePool", [IN], ["pooled"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Conv", ["pooled", "w", "b"], ["prototypes"]),
        helper.make_node("Identity", ["rows_"], ["rows"]),
    ]
    constants = {
        "w": 40 * np.eye(2, 3, dtype=np.float32)[:, :, None, None],
        "b": np.full(2, -20, np.float32),
        "rows_": np.repeat(np.asarray(rows, np.float32)[None], batch, axis=0),
    }
    outputs = {
        "rows": (FLOAT, (batch, *np.shape(rows))),
        "prototypes": (FLOAT, (batch, 2, height // 4, width // 4)),
    }
    return save(path, nodes, (batch, 3, height, width), outputs, constants=constants, metadata=metadata)
