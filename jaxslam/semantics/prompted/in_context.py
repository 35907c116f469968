"""In-context segmenters: find objects that are similar to those in example images with masks.

Wang et al., SegGPT (arXiv 2304.03284): the example is stacked above the image, and its mask above the painted output.
Inputs and output are those of transformers' `SegGptForImageSegmentation`, which stacks them itself;
`docs/export_segmenter.py` exports it.

A network with an open first axis is given all examples of a class at once. One that was exported with
`feature_ensemble=True` then averages their features; what it paints for each is averaged here in any case.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from jaxslam.errors import ConfigError, ModelError
from jaxslam.semantics.detections import Detections
from jaxslam.semantics.detector import check_image, check_share, check_threads
from jaxslam.semantics.letterbox import Placement, place, plane_to_image
from jaxslam.semantics.onnx_session import Network
from jaxslam.semantics.onnx_signature import Graph, ImageInput, Port
from jaxslam.semantics.postprocess import MAX_KEPT
from jaxslam.semantics.prompted.base import IMAGENET
from jaxslam.semantics.prompted.detector import boxes_of
from jaxslam.semantics.prompted.examples import Example

IMAGE, EXAMPLE, MASK, OUTPUT = "pixel_values", "prompt_pixel_values", "prompt_masks", "pred_masks"
_SIDE = 448  # where it is open: what SegGPT learnt from
_PAINTED = 0.5  # masks are white on black
_MIN_SHARE = 0.0005  # of the image: smaller pieces are specks


class InContextDetector:
    """Detector of objects that are similar to examples. Results for equal images are equal to the byte."""

    def __init__(self, network: Network, examples: Sequence[Example], min_score: float) -> None:
        """Combine a network with examples; call `load_in_context` instead."""
        ports = {port.name: port for port in network.graph.inputs}
        height, width = (side or _SIDE for side in ports[IMAGE].shape[-2:])
        self._network, self._min_score = network, min_score
        self._image = ImageInput(IMAGE, width, height, True, True, ports[IMAGE].dtype)
        many = all(ports[name].shape[0] is None for name in (IMAGE, EXAMPLE, MASK))
        self._prompts = {label: self._stacked(examples, label, many) for label in _labels(examples)}

    @property
    def path(self) -> Path:
        """File of the network."""
        return self._network.path

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find objects in an RGB image of any size; each connected component is one object.

        Raises:
            FrameError: If `image` is not such an image.
            ModelError: If the network fails, or its outputs have wrong shapes or are not finite.
        """
        check_image(image)
        canvas, placement = place(image, self._image.size, "stretch", 0)
        pixels = self._image.tensor(canvas, IMAGENET)
        found = [
            (score, label, mask)
            for label, batches in self._prompts.items()
            for score, mask in self._things(self._painted(pixels, batches), placement)
        ]
        found = sorted(found, key=lambda thing: -thing[0])[:MAX_KEPT]
        masks = np.array([mask for _, _, mask in found], bool).reshape(-1, *image.shape[:2])
        scores = np.array([score for score, _, _ in found], np.float32)
        return Detections(boxes_of(masks), scores, tuple(label for _, label, _ in found), masks, None)

    def _stacked(self, examples: Sequence[Example], label: str, many: bool) -> list[dict[str, np.ndarray]]:
        """Make the network's inputs for the examples of a class, all at once or one at a time."""
        rows = []
        for each in examples:
            if each.label == label:
                assert each.image is not None  # `load_in_context` has seen to it
                assert each.mask is not None
                pixels = cv2.resize(each.image, self._image.size, interpolation=cv2.INTER_LINEAR)
                mask = cv2.resize(each.mask.view(np.uint8), self._image.size, interpolation=cv2.INTER_NEAREST)
                white = np.repeat(255 * mask[..., None], 3, axis=2)
                rows.append({EXAMPLE: self._image.tensor(pixels, IMAGENET), MASK: self._image.tensor(white, IMAGENET)})
        if not many:
            return rows
        return [{name: np.concatenate([row[name] for row in rows]) for name in (EXAMPLE, MASK)}]

    def _painted(self, pixels: np.ndarray, batches: list[dict[str, np.ndarray]]) -> Float32[np.ndarray, "h w"]:
        """Return how white the network paints each pixel of its input, 0 to 1, as the mean over examples."""
        parts = []
        for batch in batches:
            num = len(batch[MASK])
            outputs = self._network.feed({IMAGE: np.repeat(pixels, num, axis=0), **batch})
            names = [port.name for port in self._network.graph.outputs]
            parts.append(self._lower_half(outputs[names.index(OUTPUT)].astype(np.float32, copy=False), num))
        mean, std = (np.asarray(values, np.float32)[:, None, None] for values in IMAGENET[1:])
        white = np.clip((np.concatenate(parts) * std + mean) / 255, 0, 1)
        return white.mean(axis=(0, 1), dtype=np.float32)

    def _lower_half(self, painted: np.ndarray, num: int) -> np.ndarray:
        width, height = self._image.size
        if painted.shape != (num, 3, 2 * height, width):
            expected = f"({num}, 3, {2 * height}, {width})"
            raise ModelError(f"{self.path.name}: output {OUTPUT}: expected shape {expected}, got {painted.shape}")
        if not np.isfinite(painted).all():
            raise ModelError(f"{self.path.name}: output {OUTPUT}: expected finite numbers, got some that are not")
        return painted[:, :, height:]

    def _things(
        self, white: Float32[np.ndarray, "h w"], placement: Placement
    ) -> list[tuple[float, Bool[np.ndarray, "_h _w"]]]:
        """Return the connected components in the image, and how white they are."""
        plane = plane_to_image(white, self._image.size, placement)
        num, piece, measures, _ = cv2.connectedComponentsWithStats((plane > _PAINTED).astype(np.uint8))
        masks = [piece == k for k in range(1, num) if measures[k, cv2.CC_STAT_AREA] >= _MIN_SHARE * plane.size]
        things = [(float(plane[mask].mean()), mask) for mask in masks]
        return [thing for thing in things if thing[0] >= self._min_score]


def is_in_context(graph: Graph) -> bool:
    """Return whether a network takes an image, an example image, and the mask of the example."""
    inputs, outputs = {port.name: port for port in graph.inputs}, {port.name for port in graph.outputs}
    return inputs.keys() == {IMAGE, EXAMPLE, MASK} and OUTPUT in outputs and all(map(_is_image, inputs.values()))


def load_in_context(
    path: Path, examples: Sequence[Example], *, min_score: float = 0.3, num_threads: int = 1
) -> InContextDetector:
    """Open an ONNX file as a detector of objects that are similar to examples.

    Args:
        path: ONNX file.
        examples: Examples with images and masks.
        min_score: Lowest score of results, 0 to 1: the mean whiteness of an object.
        num_threads: Number of threads of the network.

    Raises:
        ConfigError: If there are no examples, an example has no image or mask, or a number is out of range.
        ModelError: If the file is missing or damaged, or no in-context segmenter.
    """
    check_share("min_score", min_score)
    check_threads(num_threads)
    if not examples:
        raise ConfigError("examples: expected one or more with an image and a mask, got none")
    for each in examples:
        if each.image is None or each.mask is None:
            raise ConfigError(f"{each.origin}: expected an image and a mask of it, got none")
    network = Network(path, num_threads)
    if not is_in_context(network.graph):
        inputs = f"the inputs {IMAGE}, {EXAMPLE} and {MASK} (Bx3xHxW) and the output {OUTPUT}"
        raise ModelError(f"{path}: expected an in-context segmenter, with {inputs}, got {network.graph}")
    return InContextDetector(network, examples, float(min_score))


def _is_image(port: Port) -> bool:
    return port.is_float and len(port.shape) == 4 and port.shape[1] in (3, None)


def _labels(examples: Sequence[Example]) -> list[str]:
    return list(dict.fromkeys(each.label for each in examples))
