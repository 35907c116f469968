"""Check the results of a detector, so that errors of a user's own detector are explained."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxslam.errors import ModelError, brief_repr
from jaxslam.semantics.detections import Detections


def check_answer(found: object, height: int, width: int) -> None:
    """Refuse a result that is not `Detections` of an image.

    Args:
        found: Result of the detector.
        height: Height of the image in pixels.
        width: Width of the image in pixels.

    Raises:
        ModelError: If the result has the wrong type, or a field has a wrong shape, type or range; the message names
            the field, what was expected and what came.
    """
    if not isinstance(found, Detections):
        raise ModelError(f"detector: expected jaxslam.semantics.Detections, got {type(found).__name__}")
    _check_array("boxes", found.boxes, "f", (None, 4), "(k, 4) float32")
    count = len(found.boxes)
    _check_array("scores", found.scores, "f", (count,), f"({count},) float32, one a box")
    _check_values(found)
    labels: Any = found.labels
    if isinstance(labels, str) or not isinstance(labels, Sequence) or not all(isinstance(each, str) for each in labels):
        raise ModelError(f"detector: labels: expected a tuple of names, got {brief_repr(labels)}")
    if len(labels) != count:
        raise ModelError(f"detector: labels: expected {count}, one a box, got {len(labels)}")
    if found.masks is not None:
        shape = (count, height, width)
        _check_array("masks", found.masks, "b", shape, f"{shape} bool, one a box at the image's size")
    if found.class_mask is not None:
        shape = (height, width)
        _check_array("class_mask", found.class_mask, "b", shape, f"{shape} bool, the image's size")


def _check_array(field: str, array: object, kind: str, shape: tuple[int | None, ...], expected: str) -> None:
    if not isinstance(array, np.ndarray):
        raise ModelError(f"detector: {field}: expected {expected}, got {type(array).__name__}")
    fits = len(array.shape) == len(shape) and all(
        want in (None, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind != kind:
        raise ModelError(f"detector: {field}: expected {expected}, got {array.shape} {array.dtype}")


def _check_values(found: Detections) -> None:
    boxes, scores = found.boxes, found.scores
    in_order = np.isfinite(boxes).all(axis=1) & (boxes[:, 0] <= boxes[:, 2]) & (boxes[:, 1] <= boxes[:, 3])
    if not in_order.all():
        wrong = boxes[~in_order][0].tolist()
        raise ModelError(
            f"detector: boxes: expected left <= right and top <= bottom in pixels, got left, top, right, bottom {wrong}"
        )
    in_range = (scores >= 0) & (scores <= 1)
    if not in_range.all():
        raise ModelError(f"detector: scores: expected 0 to 1, got {scores[~in_range][0]:g}")
