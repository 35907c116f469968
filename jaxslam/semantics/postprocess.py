"""From what a network proposes to what is kept: labels, scores, non-maximum suppression."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int

from jaxslam.errors import ModelError

MAX_CANDIDATES = 1000
"""Best proposals that enter non-maximum suppression."""
MAX_KEPT = 100
"""Detections kept of one image, as in COCO's evaluation."""
_SLACK = 0.01  # quantized networks reach a little past 0 and 1


class Wanted(NamedTuple):
    """Request to a detector.

    Attributes:
        names: Every class of the network, by number.
        classes: `(c,)` true for those that are wanted.
        min_score: Least score kept, 0 to 1.
        nms_iou: Overlap (intersection over union) above which the worse of two boxes of a class is dropped.
    """

    names: tuple[str, ...]
    classes: Bool[np.ndarray, " c"]
    min_score: float
    nms_iou: float


class Candidates(NamedTuple):
    """Boxes a network proposes.

    Attributes:
        boxes: `(n, 4)` left, top, right, bottom in pixels of the input.
        scores: `(n,)` 0 to 1.
        classes: `(n,)` the best class of each.
        rows: `(n,)` where each stands in the network's output.
    """

    boxes: Float32[np.ndarray, "n 4"]
    scores: Float32[np.ndarray, " n"]
    classes: Int[np.ndarray, " n"]
    rows: Int[np.ndarray, " n"]


def probabilities(values: np.ndarray, what: str) -> Float32[np.ndarray, "..."]:
    """Values between 0 and 1, as they are.

    Raises:
        ModelError: If they are none: an export without the last activation.
    """
    if values.size:
        least, most = float(values.min()), float(values.max())
        if least < -_SLACK or most > 1 + _SLACK:
            raise ModelError(f"{what}: expected 0 to 1, got {least:.3g} to {most:.3g} (exported without activation?)")
    return np.clip(values, 0, 1).astype(np.float32, copy=False)


def best_rows(scores: Float32[np.ndarray, "n c"], wanted: Wanted) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows in which a wanted class scores enough: their numbers, and score and number of their best class.

    That may be one that is not wanted: what is a dog rather than a person is left to `choose` to drop.
    """
    rows = np.flatnonzero(scores[:, wanted.classes].max(axis=1, initial=0) >= wanted.min_score)
    classes = scores[rows].argmax(axis=1)
    return rows, scores[rows, classes], classes


def choose(candidates: Candidates, wanted: Wanted) -> Candidates:
    """The candidates that are kept, best first; of equal ones the first.

    Raises:
        ModelError: If a box is not finite.
    """
    if not np.isfinite(candidates.boxes).all():
        raise ModelError("boxes: expected finite edges, got some that are not")
    boxes, scores, classes, _ = candidates
    fits = (scores >= wanted.min_score) & wanted.classes[classes] & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    order = np.flatnonzero(fits)
    order = order[np.argsort(-scores[order], kind="stable")][:MAX_CANDIDATES]
    kept = _suppress(boxes, classes, order, wanted.nms_iou)
    return Candidates(*(field[kept] for field in candidates))


def _suppress(boxes: np.ndarray, classes: np.ndarray, order: np.ndarray, max_iou: float) -> np.ndarray:
    """Greedy non-maximum suppression within each class; a turn for each box kept, not for each proposed.

    Not OpenCV's: it sets classes apart by shifting their boxes, and boxes that begin left of the image then meet.
    """
    kept: list[int] = []
    while len(order) and len(kept) < MAX_KEPT:
        best, order = order[0], order[1:]
        kept.append(best)
        order = order[(classes[order] != classes[best]) | (box_iou(boxes[best], boxes[order]) <= max_iou)]
    return np.asarray(kept, np.intp)


def box_iou(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the `(n,)` intersection over union of one box with each of `(n, 4)`."""
    sides = np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2])
    shared = np.maximum(sides, 0).prod(axis=1)
    return shared / ((box[2:] - box[:2]).prod() + (boxes[:, 2:] - boxes[:, :2]).prod(axis=1) - shared)
