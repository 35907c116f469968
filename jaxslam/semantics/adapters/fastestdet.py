"""FastestDet: one feature map, one box a cell.

Decoding as in the notes of its repository (github.com/dog-qiuqiu/FastestDet): an anchor-free head whose graph ends
after the sigmoid of objectness and the softmax of classes.
"""

import math
from typing import ClassVar

import numpy as np

from jaxslam.semantics.adapters.anchor_grid import corners, grid
from jaxslam.semantics.adapters.base import BoxAdapter
from jaxslam.semantics.class_names import box_names
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput
from jaxslam.semantics.postprocess import Candidates, Wanted, best_rows, probabilities

STRIDE = 16
_OBJECT_POWER, _CLASS_POWER = 0.6, 0.4


class FastestDet(BoxAdapter):
    """In: BGR 0 to 1, stretched. Out: objectness, offset, size and classes of each cell."""

    name: ClassVar[str] = "fastestdet"
    interface: ClassVar[str] = "1x(5+C)xHxW, a cell every 16 pixels"
    colors = Colors(bgr=True, std=(255.0, 255.0, 255.0))

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Lay out the cells."""
        super().__init__(graph, image)
        self._cells = grid(image, (STRIDE,)).cells

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By the size of its map, and a class for each channel but five."""
        match graph.outputs:
            case (port,) if len(port.shape) == 4 and port.is_float and image.channels_first:
                batch, channels, *size = port.shape
                fits = batch == 1 and size == [math.ceil(side / STRIDE) for side in (image.height, image.width)]
                return box_names((channels or 0) - 5, graph.names) if fits else None
        return None

    def candidates(self, outputs: list[np.ndarray], wanted: Wanted) -> Candidates:
        """Center = cell + tanh(offset), size = sigmoid(size) of the image, score = objectness^0.6 x class^0.4."""
        output = outputs[0][0].reshape(outputs[0].shape[1], -1).T
        objectness, classes = probabilities(output[:, :1], "objectness"), probabilities(output[:, 5:], "classes")
        rows, scores, labels = best_rows(objectness**_OBJECT_POWER * classes**_CLASS_POWER, wanted)
        centers = (self._cells[rows] + np.tanh(output[rows, 1:3])) * STRIDE
        sizes = (0.5 + 0.5 * np.tanh(output[rows, 3:5] / 2)) * np.asarray(self.image.size, np.float32)
        return Candidates(corners(centers, sizes), scores, labels, rows)
