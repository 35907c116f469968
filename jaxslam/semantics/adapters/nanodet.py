"""NanoDet and NanoDet-Plus: the distance of each edge from a cell, as a distribution over whole strides.

Li et al., Generalized Focal Loss (arXiv 2006.04388), equation 5: a distance is the mean of its distribution. The
networks' own exports apply the sigmoid to classes, and leave the softmax over distances to the reader. They learnt
from stretched images; with the aspect kept, people in 640x480 are found more often and with fewer false boxes.
"""

from typing import ClassVar

import numpy as np

from jaxslam.semantics.adapters.anchor_grid import grid, map_sizes, num_cells
from jaxslam.semantics.adapters.base import BoxAdapter
from jaxslam.semantics.class_names import box_names
from jaxslam.semantics.letterbox import Fit
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput, Port
from jaxslam.semantics.postprocess import Candidates, Wanted, best_rows, probabilities

STRIDES = (8, 16, 32)
PLUS_STRIDES = (8, 16, 32, 64)
_COLORS = Colors(bgr=True, mean=(103.53, 116.28, 123.675), std=(57.375, 57.12, 58.395))


class NanoDet(BoxAdapter):
    """In: BGR, normalized, the image in the top left corner.

    Out: classes and distances of each of three feature maps, in any order.
    """

    name: ClassVar[str] = "nanodet"
    interface: ClassVar[str] = "1xAxC and 1xAx4(R+1) for each of the strides 8, 16, 32"
    fit: ClassVar[Fit] = "corner"
    colors = _COLORS

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Lay out the cells, and find which output is which."""
        super().__init__(graph, image)
        self._grid = grid(image, STRIDES)
        self._pairs = _pairs(graph, image) or []

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By pairs of outputs with the cells of each map."""
        pairs = _pairs(graph, image)
        return box_names(graph.outputs[pairs[0][0]].shape[-1] or 0, graph.names) if pairs else None

    def candidates(self, outputs: list[np.ndarray], wanted: Wanted) -> Candidates:
        """Distances are measured from the middle of a cell."""
        scores = np.concatenate([outputs[index][0] for index, _ in self._pairs])
        rows, scores, classes = best_rows(probabilities(scores, "classes"), wanted)
        distances = np.concatenate([outputs[index][0] for _, index in self._pairs])[rows]
        stride = self._grid.stride[rows]
        boxes = _boxes((self._grid.cells[rows] + 0.5) * stride, distances, stride)
        return Candidates(boxes, scores, classes, rows)


class NanoDetPlus(BoxAdapter):
    """In: as `NanoDet`. Out: classes, then distances, of all cells of four feature maps."""

    name: ClassVar[str] = "nanodet_plus"
    interface: ClassVar[str] = "1xAx(C+4(R+1)), A cells at strides 8, 16, 32, 64"
    fit: ClassVar[Fit] = "corner"
    colors = _COLORS

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Lay out the cells."""
        super().__init__(graph, image)
        self._grid = grid(image, PLUS_STRIDES)

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By the number of cells; the classes are COCO's or those of the metadata, the rest are distances."""
        match graph.outputs:
            case (port,) if len(port.shape) == 3 and port.is_float and image.channels_first:
                batch, cells, values = port.shape
                names = graph.names or box_names(80, None) or ()
                distances = (values or 0) - len(names)
                fits = batch == 1 and cells == num_cells(image, PLUS_STRIDES)
                return names if fits and distances >= 8 and distances % 4 == 0 else None
        return None

    def candidates(self, outputs: list[np.ndarray], wanted: Wanted) -> Candidates:
        """Distances are measured from the corner of a cell, unlike NanoDet's."""
        num_classes = len(self.names)
        rows, scores, classes = best_rows(probabilities(outputs[0][0, :, :num_classes], "classes"), wanted)
        stride = self._grid.stride[rows]
        boxes = _boxes(self._grid.cells[rows] * stride, outputs[0][0, rows, num_classes:], stride)
        return Candidates(boxes, scores, classes, rows)


def _boxes(points: np.ndarray, distances: np.ndarray, stride: np.ndarray) -> np.ndarray:
    """`(n, 4)` boxes of `(n, 4 (R + 1))` unnormalized log probabilities of left, top, right, bottom."""
    logits = distances.reshape(len(distances), 4, distances.shape[1] // 4)
    weights = np.exp(logits - logits.max(axis=2, keepdims=True))
    steps = np.arange(weights.shape[2], dtype=np.float32)
    mean = (weights * steps).sum(axis=2) / weights.sum(axis=2) * stride
    return np.concatenate([points - mean[:, :2], points + mean[:, 2:]], axis=1)


def _pairs(graph: Graph, image: ImageInput) -> list[tuple[int, int]] | None:
    """Numbers of the outputs with classes and with distances, a pair for each stride; `None` if there are none."""
    if len(graph.outputs) != 2 * len(STRIDES) or not image.channels_first:
        return None
    pairs = [_pair(graph, columns * rows) for columns, rows in map_sizes(image, STRIDES)]
    whole = [pair for pair in pairs if pair is not None]
    widths = {tuple(graph.outputs[index].shape[2] for index in pair) for pair in whole}
    return whole if len(whole) == len(STRIDES) and len(widths) == 1 else None


def _pair(graph: Graph, cells: int) -> tuple[int, int] | None:
    ports = [(number, port) for number, port in enumerate(graph.outputs) if _holds(port, cells)]
    if len(ports) != 2:
        return None
    for (first, classes), (second, distances) in (ports, ports[::-1]):
        width = distances.shape[2] or 0
        known = box_names(classes.shape[2] or 0, graph.names) is not None
        if known and width != classes.shape[2] and width >= 8 and width % 4 == 0:
            return first, second
    return None


def _holds(port: Port, cells: int) -> bool:
    return port.is_float and len(port.shape) == 3 and port.shape[:2] == (1, cells)
