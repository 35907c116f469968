"""Tiny ONNX graphs with the inputs and outputs of real networks; what they find is written into them."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

WIDTH, HEIGHT = 96, 64
"""Size of the inputs: not square, so that no axis passes for the other."""
STRIDES = (8, 16, 32)
NUM_COCO = 80
DOG = 16
_COCO_ID = {0: 1, DOG: 18}
"""Numbers of these classes among COCO's 90 ids, which networks that give whole boxes use."""
_REACH = 7  # NanoDet's largest distance in strides
_SIZES = {"float16": TensorProto.FLOAT16, "float32": TensorProto.FLOAT, "uint8": TensorProto.UINT8}


class Thing(NamedTuple):
    """What a network finds: a box in pixels of its input, its class and score, and the stride of the map it is in."""

    box: tuple[float, float, float, float]
    label: int = 0
    score: float = 0.9
    stride: int = 8

    @property
    def center(self) -> np.ndarray:
        return np.array([self.box[0] + self.box[2], self.box[1] + self.box[3]]) / 2

    @property
    def size(self) -> np.ndarray:
        return np.array([self.box[2] - self.box[0], self.box[3] - self.box[1]])


Shape = tuple[int | str, ...]


def save(
    path: Path,
    outputs: Mapping[str, np.ndarray],
    *,
    shape: Shape = (1, 3, HEIGHT, WIDTH),
    dtype: str = "float32",
    metadata: Mapping[str, str] | None = None,
    input_name: str = "images",
    open_outputs: bool = False,
) -> Path:
    """A network of these outputs, whatever the image; `open_outputs` leaves their declared sizes open."""
    nodes = [helper.make_node("Constant", [], [name], value=numpy_helper.from_array(v)) for name, v in outputs.items()]
    declared = [_declared(name, value, open_outputs) for name, value in outputs.items()]
    return write(path, nodes, [helper.make_tensor_value_info(input_name, _SIZES[dtype], shape)], declared, metadata)


def write(path: Path, nodes: list, inputs: list, outputs: list, metadata: Mapping[str, str] | None = None) -> Path:
    graph = helper.make_graph(nodes, "tiny", inputs, outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, dict(metadata or {}))
    onnx.save(model, path)
    return path


def spoilt(path: Path, output: np.ndarray, how: str) -> Path:
    """A network that is as `save` makes it for a black image and for others fails: `how` it does so."""
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, HEIGHT, WIDTH))
    few, full, start, axis, far = (np.array([number]) for number in (7, output.shape[1], 0, 1, 10**6))
    constants = {"good": output, "nan": np.full((), np.nan, np.float32), "zero": np.zeros((), np.float32)}
    constants |= {"few": few, "full": full, "start": start, "axis": axis, "far": far}
    nodes = [helper.make_node("Constant", [], [k], value=numpy_helper.from_array(v)) for k, v in constants.items()]
    nodes += [
        helper.make_node("ReduceMax", ["images"], ["most"], keepdims=0),
        helper.make_node("Greater", ["most", "zero"], ["seen"]),
    ]
    nodes += {
        "nan": [helper.make_node("Where", ["seen", "nan", "good"], ["output"])],
        "shape": [
            helper.make_node("Where", ["seen", "few", "full"], ["end"]),
            helper.make_node("Slice", ["good", "start", "end", "axis"], ["output"]),
        ],
        "run": [
            helper.make_node("Where", ["seen", "far", "start"], ["index"]),
            helper.make_node("Gather", ["axis", "index"], ["one"]),
            helper.make_node("Cast", ["one"], ["factor"], to=TensorProto.FLOAT),
            helper.make_node("Mul", ["good", "factor"], ["output"]),
        ],
    }[how]
    return write(path, nodes, [image], [helper.make_tensor_value_info("output", TensorProto.FLOAT, (1, None, None))])


def yolox(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    return save(path, {"output": yolox_output(things)}, **kwargs)


def yolox_output(things: Iterable[Thing], size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    output = np.zeros((1, num_cells(STRIDES, size), 5 + NUM_COCO), np.float32)
    for thing in things:
        row, cell = _row(thing, STRIDES, size)
        output[0, row, :2] = thing.center / thing.stride - cell
        output[0, row, 2:4] = np.log(thing.size / thing.stride)
        output[0, row, 4] = output[0, row, 5 + thing.label] = math.sqrt(thing.score)
    return output


def nanodet(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    """Distances first, and the strides the other way round: outputs may come in any order."""
    classes, distances = _distributions(things, STRIDES, middle=0.5)
    ends = np.cumsum([num_cells((stride,)) for stride in STRIDES])[:-1]
    named = {
        **{f"dis_{stride}": part for stride, part in zip(STRIDES, np.split(distances, ends, axis=1), strict=True)},
        **{f"cls_{stride}": part for stride, part in zip(STRIDES, np.split(classes, ends, axis=1), strict=True)},
    }
    return save(path, dict(reversed(named.items())), **kwargs)


def nanodet_plus(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    return save(path, {"output": np.concatenate(_distributions(things, (*STRIDES, 64), middle=0), axis=2)}, **kwargs)


def fastestdet(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    rows, columns = HEIGHT // 16, WIDTH // 16
    output = np.zeros((1, 5 + NUM_COCO, rows, columns), np.float32)
    for thing in things:
        _, (column, row) = _row(thing._replace(stride=16), (16,))
        share = thing.size / (WIDTH, HEIGHT)
        output[0, 1:3, row, column] = np.arctanh(thing.center / 16 - (column, row))
        output[0, 3:5, row, column] = np.log(share / (1 - share))
        output[0, 0, row, column] = output[0, 5 + thing.label, row, column] = thing.score
    return save(path, {"758": output}, **kwargs)


def yolov8(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    return save(path, {"output0": _yolov8_rows(things)}, **kwargs)


def yolov8_seg(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    """Each thing's mask is the upper half of the input: prototype 1 is positive there, and negative below."""
    rows = _yolov8_rows(things)
    coefficients = np.zeros((1, 32, rows.shape[2]), np.float32)
    coefficients[0, 1] = 1
    prototypes = np.zeros((1, 32, HEIGHT // 4, WIDTH // 4), np.float32)
    prototypes[0, 1, : HEIGHT // 8], prototypes[0, 1, HEIGHT // 8 :] = 5, -5
    return save(path, {"output0": np.concatenate([rows, coefficients], axis=1), "output1": prototypes}, **kwargs)


def tensorflow_ssd(path: Path, things: Iterable[Thing], *, lite: bool = False, **kwargs) -> Path:
    """One row more than is counted, which is not to be read; COCO's ids begin at 1, TensorFlow Lite's at 0."""
    rows = [*things, Thing((0, 0, WIDTH, HEIGHT), score=1.0)]
    boxes = np.array([thing.box for thing in rows])[:, [1, 0, 3, 2]] / (HEIGHT, WIDTH, HEIGHT, WIDTH)
    classes = np.array([[_COCO_ID.get(thing.label, thing.label) - lite for thing in rows]], np.float32)
    values = {
        "boxes": boxes[None].astype(np.float32),
        "classes": classes,
        "scores": np.array([[thing.score for thing in rows]], np.float32),
        "count": np.array([len(rows) - 1], np.float32),
    }
    lite_name = "TFLite_Detection_PostProcess"
    names = [lite_name, f"{lite_name}:1", f"{lite_name}:2", f"{lite_name}:3"]
    zoo = ["detection_boxes:0", "detection_classes:0", "detection_scores:0", "num_detections:0"]
    outputs = dict(zip(names if lite else zoo, values.values(), strict=True))
    return save(path, outputs, **({"shape": (1, HEIGHT, WIDTH, 3), "dtype": "uint8"} | kwargs))


def lite_ssd(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    return tensorflow_ssd(path, things, lite=True, **({"dtype": "float32"} | kwargs))


def torchvision_ssd(path: Path, things: Iterable[Thing], **kwargs) -> Path:
    rows = list(things)
    outputs = {
        "boxes": np.array([thing.box for thing in rows], np.float32).reshape(-1, 4),
        "scores": np.array([thing.score for thing in rows], np.float32),
        "labels": np.array([_COCO_ID.get(thing.label, thing.label) for thing in rows], np.int64),
    }
    return save(path, outputs, **({"shape": (3, HEIGHT, WIDTH), "open_outputs": True} | kwargs))


def num_cells(strides: tuple[int, ...], size: tuple[int, int] = (WIDTH, HEIGHT)) -> int:
    return sum(math.ceil(size[0] / stride) * math.ceil(size[1] / stride) for stride in strides)


def _row(
    thing: Thing, strides: tuple[int, ...], size: tuple[int, int] = (WIDTH, HEIGHT)
) -> tuple[int, tuple[int, int]]:
    """Row of the cell that holds a thing's center, and the cell's column and row in its map."""
    column, row = (int(value // thing.stride) for value in thing.center)
    before = num_cells(strides[: strides.index(thing.stride)], size)
    return before + row * math.ceil(size[0] / thing.stride) + column, (column, row)


def _yolov8_rows(things: Iterable[Thing]) -> np.ndarray:
    output = np.zeros((1, 4 + NUM_COCO, num_cells(STRIDES)), np.float32)
    for thing in things:
        row, _ = _row(thing, STRIDES)
        output[0, :4, row] = [*thing.center, *thing.size]
        output[0, 4 + thing.label, row] = thing.score
    return output


def _distributions(things: Iterable[Thing], strides: tuple[int, ...], middle: float) -> tuple[np.ndarray, np.ndarray]:
    """NanoDet's classes and distances: all weight of a distance on the two whole numbers beside it."""
    classes = np.zeros((1, num_cells(strides), NUM_COCO), np.float32)
    distances = np.zeros((1, num_cells(strides), 4, _REACH + 1), np.float32)
    for thing in things:
        row, cell = _row(thing, strides)
        classes[0, row, thing.label] = thing.score
        point = (np.array(cell) + middle) * thing.stride
        edges = np.concatenate([point - thing.box[:2], thing.box[2:] - point]) / thing.stride
        assert 0 <= edges.min() <= edges.max() <= _REACH, "the box does not fit its stride"
        weights = np.maximum(1 - np.abs(edges[:, None] - np.arange(_REACH + 1)), 1e-9)
        distances[0, row] = np.log(weights) + 40  # a constant takes nothing from a distribution
    return classes, distances.reshape(1, -1, 4 * (_REACH + 1))


def _declared(name: str, value: np.ndarray, is_open: bool) -> onnx.ValueInfoProto:
    shape = [f"{name}_{axis}" for axis in range(value.ndim)] if is_open else value.shape
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(value.dtype), shape)
