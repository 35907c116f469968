"""Semantic segmentation: a class for every pixel (DeepLab, SegNet and the like)."""

from typing import ClassVar

import numpy as np

from jaxslam.errors import ModelError
from jaxslam.semantics.adapters.base import Adapter
from jaxslam.semantics.class_names import VOC, pixel_names
from jaxslam.semantics.detections import Detections, no_detections
from jaxslam.semantics.letterbox import Fit, Placement, plane_to_image
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput, Port
from jaxslam.semantics.postprocess import Wanted

_IGNORED = 255  # VOC's and Cityscapes' number for what is no class
_MAX_COARSE = 32  # pixels of the input for one of the map


class ClassMap(Adapter):
    """Whole numbers, or a score for each class, at any resolution.

    In: RGB; 0 to 255 for integers, -1 to 1 for real numbers with channels last (TensorFlow), and with channels first
    normalized by ImageNet's mean and deviation (torchvision). The image keeps its aspect, in the top left corner.

    Whole numbers do not say how many classes there are: without names in the metadata they are taken to be VOC's, and a
    number that VOC does not have is an error. Least scores do not apply: each pixel is of its best class.
    """

    name: ClassVar[str] = "class_map"
    interface: ClassVar[str] = "integers 1xHxW (VOC's or with names), or scores 1xCxHxW or 1xHxWxC (21 or with names)"
    fit: ClassVar[Fit] = "corner"
    pad: ClassVar[int] = 127

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Choose how values enter."""
        super().__init__(graph, image)
        half = (127.5, 127.5, 127.5)
        imagenet = Colors(mean=(123.675, 116.28, 103.53), std=(58.395, 57.12, 57.375))
        self.colors = imagenet if image.channels_first else Colors(mean=half, std=half)

    @classmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """By an output over the whole input; torchvision's `aux` beside it is left alone."""
        ports = [port for port in graph.outputs if port.name != "aux"]
        if len(ports) != 1 or ports[0] != graph.outputs[0]:
            return None
        if ports[0].is_integer:
            return (graph.names or VOC) if _covers(_integer_size(ports[0]), image) else None
        classes, size = _score_shape(ports[0], image)
        return pixel_names(classes, graph.names) if _covers(size, image) else None

    def decode(self, outputs: list[np.ndarray], placement: Placement, wanted: Wanted) -> Detections:
        """The pixels of wanted classes, at the image's size."""
        size = _integer_size(self.graph.outputs[0])
        if self.graph.outputs[0].is_integer:
            margin = _membership(outputs[0].reshape(size), wanted)
        else:
            margin = _margin(outputs[0][0] if self.image.channels_first else outputs[0][0].transpose(2, 0, 1), wanted)
        mask = plane_to_image(margin, self.image.size, placement) > 0
        return no_detections()._replace(class_mask=mask)


def _membership(numbers: np.ndarray, wanted: Wanted) -> np.ndarray:
    """1 where the class is wanted, -1 elsewhere."""
    num_classes = len(wanted.classes)
    known = (numbers >= 0) & ((numbers < num_classes) | (numbers == _IGNORED))
    if not known.all():
        raise ModelError(f"class map: expected 0 to {num_classes - 1}, got {numbers[~known].max()} (give it `names`)")
    table = np.full(max(num_classes, _IGNORED + 1), -1, np.float32)
    table[:num_classes][wanted.classes] = 1
    return table[numbers]


def _margin(scores: np.ndarray, wanted: Wanted) -> np.ndarray:
    """By how much the best wanted class is ahead of the best other, `(h, w)` of `(c, h, w)`."""
    if wanted.classes.all():
        return np.ones(scores.shape[1:], np.float32)
    ahead = scores[wanted.classes].max(axis=0) - scores[~wanted.classes].max(axis=0)
    return np.ascontiguousarray(ahead, np.float32)


def _integer_size(port: Port) -> tuple[int, ...]:
    return tuple(size for size in port.shape if size and size != 1)


def _score_shape(port: Port, image: ImageInput) -> tuple[int, tuple[int, ...]]:
    """Classes, and height and width; zeros if it holds none."""
    if not port.is_float or len(port.shape) != 4 or port.shape[0] != 1:
        return 0, ()
    sizes = tuple(size or 0 for size in port.shape[1:])
    return (sizes[0], sizes[1:]) if image.channels_first else (sizes[2], sizes[:2])


def _covers(size: tuple[int, ...], image: ImageInput) -> bool:
    """Whether a map is about as fine as the input, and of its aspect."""
    if len(size) != 2:
        return False
    steps = (image.height / size[0], image.width / size[1])
    return all(0.9 <= step <= _MAX_COARSE for step in steps) and 0.9 < steps[0] / steps[1] < 1.1
