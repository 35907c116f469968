"""Networks that choose their boxes themselves: SSD and relatives with outputs of boxes, scores and classes.

Outputs are told apart by their names, because their shapes are the same. The names also tell how boxes and classes
are meant, which nothing else in the graph does:

| names | boxes | classes |
|---|---|---|
| `detection_boxes`, `detection_scores`, `detection_classes` (TensorFlow detection zoo) | top, left, bottom, right, 0 to 1 | COCO's ids, from 1 |
| `TFLite_Detection_PostProcess`, `:1`, `:2`, `:3`: boxes, classes, scores, count (TensorFlow Lite) | the same | COCO's ids less 1 |
| `boxes`, `scores`, `labels` or `classes` (torchvision) | left, top, right, bottom, pixels of the input | COCO's ids, from 1 |

Names in the model's metadata take the place of COCO's, by the number that the network gives.
"""  # noqa: E501

from typing import ClassVar, NamedTuple

import numpy as np

from jaxslam.errors import ModelError
from jaxslam.semantics.adapters.base import BoxAdapter
from jaxslam.semantics.class_names import COCO_IDS
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput, Port
from jaxslam.semantics.postprocess import Candidates, Wanted, probabilities


class _Family(NamedTuple):
    """Names of outputs, and how they are meant."""

    boxes: str
    scores: str
    classes: str
    counter: str
    pixels: bool
    names: tuple[str, ...]


_LITE = "TFLite_Detection_PostProcess"
_FAMILIES = (
    _Family("detection_boxes", "detection_scores", "detection_classes", "num_detections", False, COCO_IDS),
    _Family(_LITE, f"{_LITE}:2", f"{_LITE}:1", f"{_LITE}:3", False, COCO_IDS[1:]),
    _Family("boxes", "scores", "labels", "count", True, COCO_IDS),
    _Family("boxes", "scores", "classes", "count", True, COCO_IDS),
)
_MAX_SHARE = 4.0
"""How far past the input a box given as a share of it may reach; pixels lie beyond."""


class _Layout(NamedTuple):
    """Roles of the outputs, and their units."""

    boxes: int
    scores: int
    classes: int
    counter: int | None
    pixels: bool
    names: tuple[str, ...]


class Ssd(BoxAdapter):
    """In: RGB, stretched: 0 to 255 for integers, -1 to 1 for TensorFlow's real numbers, 0 to 1 for torchvision's."""

    name: ClassVar[str] = "ssd"
    interface: ClassVar[str] = (
        "boxes 1xNx4, scores 1xN, classes 1xN (and a count), named as TensorFlow, TensorFlow Lite or torchvision do"
    )
    varying: ClassVar[bool] = True

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Find which output is which."""
        super().__init__(graph, image)
        layout = _layout(graph)
        assert layout is not None  # it fits
        self._layout = layout
        half = (127.5, 127.5, 127.5)
        self.colors = Colors(std=(255.0, 255.0, 255.0)) if image.channels_first else Colors(mean=half, std=half)

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By the names of its outputs."""
        layout = _layout(graph)
        return layout.names if layout else None

    def candidates(self, outputs: list[np.ndarray], wanted: Wanted) -> Candidates:
        """The network's boxes, as far as it counts them."""
        layout = self._layout
        boxes, scores, classes = self._rows(outputs)
        rows = np.flatnonzero(probabilities(scores, "scores") >= wanted.min_score)
        chosen, numbers = boxes[rows].astype(np.float32, copy=False), np.round(classes[rows]).astype(np.intp)
        if len(rows) and not 0 <= numbers.min() <= numbers.max() < len(self.names):
            most = len(self.names) - 1
            raise ModelError(f"classes: expected 0 to {most}, got {numbers.min()} to {numbers.max()}")
        if not layout.pixels:
            if len(rows) and np.abs(chosen).max() > _MAX_SHARE:
                raise ModelError(f"boxes: expected shares of the input, 0 to 1, got up to {np.abs(chosen).max():g}")
            chosen = chosen[:, [1, 0, 3, 2]] * np.tile(np.asarray(self.image.size, np.float32), 2)
        return Candidates(chosen, probabilities(scores[rows], "scores"), numbers, rows)

    def _rows(self, outputs: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Boxes, scores and classes, `(n, 4)`, `(n,)` and `(n,)`."""
        layout = self._layout
        boxes = outputs[layout.boxes]
        if boxes.shape[-1] != 4:
            raise ModelError(f"output {self.graph.outputs[layout.boxes].name}: expected (n, 4), got {boxes.shape}")
        boxes = boxes.reshape(-1, 4)
        scores, classes = outputs[layout.scores].reshape(-1), outputs[layout.classes].reshape(-1)
        if not len(boxes) == len(scores) == len(classes):
            counts = f"{len(boxes)}, {len(scores)} and {len(classes)}"
            raise ModelError(f"outputs: expected as many boxes as scores and classes, got {counts}")
        count = len(boxes) if layout.counter is None else int(outputs[layout.counter].reshape(-1)[0])
        return boxes[:count], scores[:count], classes[:count]


def _layout(graph: Graph) -> _Layout | None:
    """Find out how to read the outputs of a graph; `None` if their names or shapes do not tell."""
    places = {port.name.removesuffix(":0"): place for place, port in enumerate(graph.outputs)}
    for family in _FAMILIES:
        numbers = [places[name] for name in family[:3] if name in places]
        if len(numbers) == 3 and _fit_together(*(graph.outputs[number] for number in numbers)):
            boxes, scores, classes = numbers
            names = graph.names or family.names
            return _Layout(boxes, scores, classes, places.get(family.counter), family.pixels, names)
    return None


def _fit_together(boxes: Port, scores: Port, classes: Port) -> bool:
    """Whether they have the shapes of boxes with scores and classes, with or without a batch of one."""
    shapes = boxes.is_float and scores.is_float and len(boxes.shape) in (2, 3) and boxes.shape[-1] == 4
    return shapes and scores.shape == classes.shape == boxes.shape[:-1] and boxes.shape[:-2] in ((), (1,))
