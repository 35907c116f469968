"""Tells a good network from a bad one by what it finds in pictures that come with jaxslam.

Detectors see a photograph of an astronaut (NASA, public domain, part of scikit-image). Segmenters see drawn shapes that
fill less than half of their boxes, so that painting the box, everything or nothing is far off.
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from jaxslam.semantics.detections import Detections, Detector
from jaxslam.semantics.onnx_session import Network
from jaxslam.semantics.postprocess import box_iou
from jaxslam.semantics.prompted.detector import boxes_of
from jaxslam.semantics.prompted.examples import Example
from jaxslam.semantics.prompted.in_context import is_in_context, load_in_context
from jaxslam.semantics.prompted.prompt import prompt
from jaxslam.semantics.prompted.segmenter import PromptSegmenter

GOOD_BOX_IOU = 0.68
"""Smallest IoU of a good detector with the box of the astronaut; six real networks have 0.71 to 0.98, the box
of the whole picture 0.66."""
GOOD_MASK_IOU = 0.65
"""Smallest median IoU of a good segmenter with the shapes; painted boxes have 0.4."""
LABEL = "person"
"""Class of what is to be found in the photograph."""

_ASTRONAUT = (13.0, 15.0, 365.0, 510.0)
"""Left, top, right and bottom of the person, pixels."""
_WIDTH, _HEIGHT = 640, 480
_SEED, _GRAIN = 0, 9.0
_COLORS = ((240, 214, 120), (150, 220, 240), (245, 175, 190), (175, 235, 160))


class NetworkCheck(NamedTuple):
    """Result of checking a network on a picture whose content is known.

    Attributes:
        picture: `(h, w, 3)` RGB picture.
        found: What the network found in it.
        things: Name of each thing that is there.
        ious: IoU of what was found of each thing with the truth.
        least: Smallest median of these of a good network.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    found: Detections
    things: tuple[str, ...]
    ious: tuple[float, ...]
    least: float

    @property
    def iou(self) -> float:
        """Median of the IoUs."""
        return float(np.median(self.ious))

    @property
    def good(self) -> bool:
        """True if the network found what is there."""
        return self.iou >= self.least


def check_detector(detector: Detector) -> NetworkCheck:
    """Check whether a detector of people finds the one in a photograph.

    Raises:
        ModelError: If the network fails.
    """
    from skimage.data import astronaut  # noqa: PLC0415 - only this check needs it

    picture = astronaut()
    found = detector(picture)
    boxes = found.boxes[[label == LABEL for label in found.labels]]
    if found.class_mask is not None and found.class_mask.any():
        boxes = np.concatenate([boxes, boxes_of(found.class_mask[None])])
    best = box_iou(np.array(_ASTRONAUT), boxes).max(initial=0.0)
    return NetworkCheck(picture, found, (LABEL,), (float(best),), GOOD_BOX_IOU)


def check_segmenter(segmenter: PromptSegmenter) -> NetworkCheck:
    """Check whether a promptable segmenter makes the masks of shapes from their boxes.

    Raises:
        ModelError: If a network fails.
    """
    picture, shapes = drawn_shapes()
    truth = np.array(list(shapes.values()))
    masks, ious = segmenter(picture, [prompt(name, box=box) for name, box in zip(shapes, boxes_of(truth), strict=True)])
    found = Detections(boxes_of(truth), np.clip(ious, 0, 1), tuple(shapes), masks, None)
    return _of_masks(picture, found, tuple(shapes), masks, truth)


def check_in_context(path: Path) -> NetworkCheck:
    """Check whether an in-context segmenter finds shapes in a mirrored picture, each from the picture as an example.

    Raises:
        ModelError: If it is no such network, or fails.
    """
    picture, shapes = drawn_shapes()
    mirrored = np.ascontiguousarray(picture[:, ::-1])
    examples = [Example(f"shape {name}", name, picture, mask, ()) for name, mask in shapes.items()]
    found = load_in_context(path, examples)(mirrored)
    assert found.masks is not None  # such a network gives masks
    labels = np.array(found.labels)
    masks = np.array([found.masks[labels == name].any(axis=0) for name in shapes])
    return _of_masks(mirrored, found, tuple(shapes), masks, np.array(list(shapes.values()))[:, :, ::-1])


def is_example_network(path: Path) -> bool:
    """Return whether a file is an in-context segmenter, which needs an example of what to find.

    Raises:
        ModelError: If it is missing or damaged.
    """
    return is_in_context(Network(path, 1).graph)


def drawn_shapes() -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Bool[np.ndarray, "h w"]]]:
    """Draw light shapes on dark, mottled ground; return the RGB picture and the mask of each shape by name."""
    noise = np.random.default_rng(_SEED)
    mottled = cv2.GaussianBlur(noise.normal(0, 120, (_HEIGHT, _WIDTH, 3)), (0, 0), 5)
    picture = 55 + mottled + noise.normal(0, _GRAIN, mottled.shape)
    shapes = {}
    for (name, corners), color in zip(_corners().items(), _COLORS, strict=True):
        mask = np.zeros((_HEIGHT, _WIDTH), np.uint8)
        cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 1)
        shapes[name] = mask.astype(bool)
        light = np.linspace(0.9, 1.05, _WIDTH)[None, :, None]  # brighter to the right
        shaded = light * np.array(color, float) + noise.normal(0, _GRAIN, mottled.shape)
        picture = np.where(shapes[name][..., None], shaded, picture)
    return np.clip(picture, 0, 255).astype(np.uint8), shapes


def _corners() -> dict[str, np.ndarray]:
    """Return the corners `(n, 2)` of the shapes, pixels.

    Each shape covers the middle of its box, by which some networks are asked.
    """
    turn = np.arange(10) * np.pi / 5
    radius = np.where(np.arange(10) % 2, 48.0, 110.0)
    star = radius[:, None] * np.stack([np.sin(turn), -np.cos(turn)], axis=1)
    half_cross = np.array([(-27, -100), (27, -100), (27, -27), (100, -27), (100, 27), (27, 27)])
    bar = np.array([(-115, -82), (-65, -102), (115, 78), (65, 103)])
    along = np.linspace(-1, 1, 20)[:, None]
    half_leaf = 92 * along * (1, -0.93) + 31 * np.cos(np.pi / 2 * along) * (0.93, 1)
    shapes = {
        "star": (star, (160, 125)),
        "cross": (np.concatenate([half_cross, -half_cross]), (480, 120)),
        "bar": (bar, (170, 352)),
        "leaf": (np.concatenate([half_leaf, -half_leaf]), (485, 355)),
    }
    return {name: corners + np.array(middle) for name, (corners, middle) in shapes.items()}


def _of_masks(
    picture: np.ndarray, found: Detections, things: tuple[str, ...], masks: np.ndarray, truth: np.ndarray
) -> NetworkCheck:
    ious = tuple(_mask_iou(mask, true) for mask, true in zip(masks, truth, strict=True))
    return NetworkCheck(picture, found, things, ious, GOOD_MASK_IOU)


def _mask_iou(mask: np.ndarray, true: np.ndarray) -> float:
    return float((mask & true).sum() / (mask | true).sum())
