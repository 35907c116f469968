"""Detectors that run an ONNX network."""

import os
from collections.abc import Collection
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from jaxslam.errors import ConfigError, FrameError, ModelError, nearest
from jaxslam.semantics.adapters import ADAPTERS, Adapter
from jaxslam.semantics.class_names import FoundClasses, find_classes, valid_labels
from jaxslam.semantics.detections import Detections
from jaxslam.semantics.onnx_session import Network, check_outputs
from jaxslam.semantics.onnx_signature import Graph
from jaxslam.semantics.postprocess import Wanted


class OnnxDetector:
    """Detector of objects of chosen classes. Results for equal images are equal to the byte."""

    def __init__(self, network: Network, adapter: Adapter, wanted: Wanted, classes: FoundClasses) -> None:
        """Combine a network with its adapter and the wanted classes; call `load_detector` instead."""
        self._network, self._adapter, self._wanted = network, adapter, wanted
        self._classes = classes

    @property
    def adapter(self) -> str:
        """Name of the network's adapter."""
        return self._adapter.name

    @property
    def labels(self) -> tuple[str, ...]:
        """Classes that it looks for, by COCO's names."""
        return self._classes.known

    @property
    def missing_labels(self) -> tuple[str, ...]:
        """Wanted classes that the network does not know, by COCO's names."""
        return self._classes.missing

    @property
    def path(self) -> Path:
        """File of the network."""
        return self._network.path

    @property
    def input_size(self) -> tuple[int, int]:
        """Size `(width, height)` of the network's input in pixels."""
        return self._adapter.image.size

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find objects in an RGB image of any size.

        Raises:
            FrameError: If `image` is not such an image.
            ModelError: If the network fails, or its outputs have wrong shapes or are not finite.
        """
        check_image(image)
        tensor, placement = self._adapter.prepare(image)
        outputs = self._network.run(tensor)
        try:
            check_outputs(outputs, self._network.graph.outputs, self._adapter.varying)
            return self._adapter.decode(outputs, placement, self._wanted)
        except ModelError as error:
            raise ModelError(f"{self.path.name}: {error}") from None


def load_detector(
    path: str | os.PathLike[str],
    *,
    labels: Collection[str] = ("person",),
    min_score: float = 0.3,
    nms_iou: float = 0.5,
    adapter: str | None = None,
    num_threads: int = 1,
) -> OnnxDetector:
    """Open an ONNX file as a detector; the adapter is chosen by the graph's inputs and outputs.

    Args:
        path: ONNX file.
        labels: Classes to find, as COCO ("person", "car", ...), PASCAL VOC or the network names them, and groups of
            classes: "people", "vehicles", "animals", "furniture", "bags", "handheld". Those that the network does not
            know are left out; see `OnnxDetector.missing_labels`.
        min_score: Lowest score of results, 0 to 1.
        nms_iou: Intersection over union, 0 to 1, above which the box with the lower score of two boxes of a class is
            dropped.
        adapter: Name in `jaxslam.semantics.adapters.ADAPTERS`; by default the adapter that fits the graph.
        num_threads: Number of threads of the network.

    Raises:
        ConfigError: If a label is unknown, the network knows none of the classes, or a number is out of range.
        ModelError: If the file is missing or damaged, or fits no adapter or not the named one.
    """
    check_share("min_score", min_score)
    check_share("nms_iou", nms_iou)
    check_threads(num_threads)
    if adapter is not None and adapter not in ADAPTERS:
        raise ModelError(f"adapter: expected one of {', '.join(ADAPTERS)}, got {adapter!r}{nearest(adapter, ADAPTERS)}")
    network = Network(Path(path), num_threads)
    kind = _family(network, adapter)
    assert network.graph.image is not None  # it fits
    fitted = kind(network.graph, network.graph.image)
    classes = _known_classes(labels, fitted.names, network.path)
    flags = np.array([name in classes.known for name in fitted.names])
    wanted = Wanted(fitted.names, flags, float(min_score), float(nms_iou))
    return OnnxDetector(network, fitted, wanted, classes)


def _family(network: Network, adapter: str | None) -> type[Adapter]:
    graph = network.graph
    if adapter is not None:
        if not ADAPTERS[adapter].fits(graph):
            wanted = f"{network.path}: expected a network for the adapter {adapter} ({ADAPTERS[adapter].interface})"
            raise ModelError(f"{wanted}, got {graph}{_fitting_hint(graph)}")
        return ADAPTERS[adapter]
    fitting = _fitting(graph)
    if len(fitting) != 1:
        kinds = "; ".join(f"{name}: {kind.interface}" for name, kind in ADAPTERS.items())
        found = f"{graph}, which fits {' and '.join(fitting)}: name one" if fitting else str(graph)
        raise ModelError(
            f"{network.path}: expected one image 1x3xHxW or 1xHxWx3 as input, classes whose names are known, and the"
            f" outputs of one of these families: {kinds}; got {found}"
        )
    return ADAPTERS[fitting[0]]


def _fitting(graph: Graph) -> list[str]:
    return [name for name, kind in ADAPTERS.items() if kind.fits(graph)]


def _fitting_hint(graph: Graph) -> str:
    fitting = _fitting(graph)
    return f" (it fits {' and '.join(fitting)})" if fitting else ""


def _known_classes(labels: Collection[str], names: tuple[str, ...], path: Path) -> FoundClasses:
    """Look up the wanted classes of a network, of which it must know one."""
    classes = find_classes(labels, names)
    if not classes.known:
        valid = ", ".join(valid_labels(names))
        raise ConfigError(f"labels: expected classes of {path} ({valid}), got {', '.join(labels)}")
    return classes


def check_share(field: str, value: float) -> None:
    """Refuse a value that is not a number from 0 to 1.

    Raises:
        ConfigError: If the value is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise ConfigError(f"{field}: expected a number from 0 to 1, got {value!r}")


def check_threads(num_threads: int) -> None:
    """Refuse a number of threads that is not a positive integer.

    Raises:
        ConfigError: If the number is none.
    """
    if isinstance(num_threads, bool) or not isinstance(num_threads, int) or num_threads < 1:
        raise ConfigError(f"num_threads: expected an integer >= 1, got {num_threads!r}")


def check_image(image: object) -> None:
    """Refuse an image that detectors do not accept.

    Raises:
        FrameError: If the image is not `(h, w, 3)` uint8.
    """
    expected = "image: expected (height, width, 3) RGB uint8"
    if not isinstance(image, np.ndarray):
        raise FrameError(f"{expected}, got {type(image).__name__}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise FrameError(f"{expected}, got {image.dtype} of shape {image.shape}")
