"""YOLOv8 and YOLO11 as Ultralytics exports them without non-maximum suppression: boxes, and instance masks.

Masks are sums of prototypes: Bolya et al., YOLACT (arXiv 1904.02689), section 3.
"""

from typing import ClassVar

import numpy as np

from jaxslam.semantics.adapters.anchor_grid import corners, num_cells
from jaxslam.semantics.adapters.base import Adapter, BoxAdapter, found
from jaxslam.semantics.class_names import box_names
from jaxslam.semantics.detections import Detections
from jaxslam.semantics.letterbox import Fit, Placement, boxes_to_image, plane_to_image
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput, Port
from jaxslam.semantics.postprocess import Candidates, Wanted, best_rows, choose, probabilities

STRIDES = (8, 16, 32)
_COLORS = Colors(std=(255.0, 255.0, 255.0))


class YoloV8(BoxAdapter):
    """In: RGB 0 to 1, the image in the middle. Out: center, size and classes of each cell, in pixels of the input."""

    name: ClassVar[str] = "yolov8"
    interface: ClassVar[str] = "1x(4+C)xA, A cells at strides 8, 16, 32"
    fit: ClassVar[Fit] = "center"
    colors = _COLORS

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By the number of cells, and a class for each number but four."""
        match graph.outputs:
            case (port,) if _is_boxes(port, image):
                return box_names((port.shape[1] or 0) - 4, graph.names)
        return None

    def candidates(self, outputs: list[np.ndarray], wanted: Wanted) -> Candidates:
        """Decode boxes and scores, which need no activation."""
        return _candidates(outputs[0][0].T, len(self.names), wanted)


class YoloV8Seg(Adapter):
    """`YoloV8` with coefficients for prototypes of masks behind the classes."""

    name: ClassVar[str] = "yolov8_seg"
    interface: ClassVar[str] = "1x(4+C+K)xA and 1xKxHxW, K prototypes of masks"
    fit: ClassVar[Fit] = "center"
    colors = _COLORS

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Find which output is which."""
        super().__init__(graph, image)
        self._boxes = 0 if len(graph.outputs[0].shape) == 3 else 1

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By the number of cells, and the number of prototypes."""
        match sorted(graph.outputs, key=lambda port: len(port.shape)):
            case (boxes, masks) if _is_boxes(boxes, image) and len(masks.shape) == 4 and masks.is_float:
                return box_names((boxes.shape[1] or 0) - 4 - (masks.shape[1] or 0), graph.names)
        return None

    def decode(self, outputs: list[np.ndarray], placement: Placement, wanted: Wanted) -> Detections:
        """The best boxes with their masks; a mask ends where its box does."""
        rows, prototypes = outputs[self._boxes][0].T, outputs[1 - self._boxes][0].astype(np.float32, copy=False)
        kept = choose(_candidates(rows, len(self.names), wanted), wanted)
        coefficients = rows[kept.rows, 4 + len(self.names) :].astype(np.float32, copy=False)
        planes = np.einsum("nk,khw->nhw", coefficients, prototypes)
        boxes = boxes_to_image(kept.boxes, placement)
        masks = np.zeros((len(planes), *placement.size[::-1]), bool)
        for mask, plane, box in zip(masks, planes, boxes, strict=True):
            self._fill(mask, plane, box, placement)
        return found(kept, placement, wanted.names, masks)

    def _fill(self, mask: np.ndarray, plane: np.ndarray, box: np.ndarray, placement: Placement) -> None:
        """Set the pixels inside a box where the logit is positive."""
        edge = np.tile(placement.size, 2)
        left, top, right, bottom = np.clip(np.round(box), 0, edge).astype(int).tolist()
        if right > left and bottom > top:
            window = (left, top, right, bottom)
            mask[top:bottom, left:right] = plane_to_image(plane, self.image.size, placement, window) > 0


def _is_boxes(port: Port, image: ImageInput) -> bool:
    cells = num_cells(image, STRIDES)
    return image.channels_first and port.is_float and port.shape[::2] == (1, cells) and len(port.shape) == 3


def _candidates(output: np.ndarray, num_classes: int, wanted: Wanted) -> Candidates:
    """Decode `(a, 4 + c + k)`: center x, y, width, height, classes and anything behind them."""
    rows, scores, classes = best_rows(probabilities(output[:, 4 : 4 + num_classes], "classes"), wanted)
    boxes = output[rows, :4].astype(np.float32, copy=False)
    return Candidates(corners(boxes[:, :2], boxes[:, 2:]), scores, classes, rows)
