"""YOLOX: boxes per cell of three feature maps, not yet in pixels.

Ge et al., YOLOX: Exceeding YOLO Series in 2021 (arXiv 2107.08430), as its own ONNX export gives it.
"""

from typing import ClassVar

import numpy as np

from jaxslam.errors import ModelError
from jaxslam.semantics.adapters.anchor_grid import corners, grid, num_cells
from jaxslam.semantics.adapters.base import BoxAdapter
from jaxslam.semantics.class_names import box_names
from jaxslam.semantics.letterbox import Fit
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput
from jaxslam.semantics.postprocess import Candidates, Wanted, best_rows, probabilities

STRIDES = (8, 16, 32)
_MAX_LOG_SIZE = 10.0
"""e^10 strides are no box in any image; an export that has decoded its boxes gives more."""


class YoloX(BoxAdapter):
    """In: BGR 0 to 255, the image in the top left corner. Out: center, size, objectness and classes of each cell."""

    name: ClassVar[str] = "yolox"
    interface: ClassVar[str] = "1xAx(5+C), A cells at strides 8, 16, 32"
    fit: ClassVar[Fit] = "corner"
    colors = Colors(bgr=True)

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Lay out the cells."""
        super().__init__(graph, image)
        self._grid = grid(image, STRIDES)

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By the number of cells, and a class for each number but five."""
        match graph.outputs:
            case (port,) if len(port.shape) == 3 and port.is_float and image.channels_first:
                batch, cells, values = port.shape
                fits = batch == 1 and cells == num_cells(image, STRIDES)
                return box_names((values or 0) - 5, graph.names) if fits else None
        return None

    def candidates(self, outputs: list[np.ndarray], wanted: Wanted) -> Candidates:
        """Center = (cell + offset) stride, size = exp(size) stride, score = objectness x class."""
        output = outputs[0][0]
        likely = np.flatnonzero(probabilities(output[:, 4], "objectness") >= wanted.min_score)
        proposed = output[likely]
        scores = probabilities(proposed[:, 5:], "classes") * probabilities(proposed[:, 4:5], "objectness")
        rows, scores, classes = best_rows(scores, wanted)
        center, size = proposed[rows, :2], proposed[rows, 2:4]
        rows = likely[rows]
        cells, stride = self._grid.cells[rows], self._grid.stride[rows]
        most = float(size.max(initial=0))
        if most > _MAX_LOG_SIZE:
            got = f"{most:g} (exported with boxes in pixels?)"
            raise ModelError(f"sizes: expected logarithms of strides up to {_MAX_LOG_SIZE:g}, got {got}")
        return Candidates(corners((cells + center) * stride, np.exp(size) * stride), scores, classes, rows)
