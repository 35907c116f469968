"""A promptable segmenter as a detector: prompts come from the boxes of another one, or are the same in every frame."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from jaxslam.errors import ConfigError
from jaxslam.semantics.detections import Detections, Detector, no_detections
from jaxslam.semantics.detector import check_image, check_share
from jaxslam.semantics.prompted.prompt import Prompt, prompt
from jaxslam.semantics.prompted.segmenter import PromptSegmenter


class PromptedDetector:
    """Instance masks of what a detector finds, and of what is prompted for."""

    def __init__(
        self,
        segmenter: PromptSegmenter,
        detector: Detector | None = None,
        *,
        prompts: Sequence[Prompt] = (),
        min_iou: float = 0.5,
    ) -> None:
        """Prepare.

        Args:
            segmenter: Makes the masks.
            detector: Its boxes are prompts; a class map of its own is passed on.
            prompts: Further ones, the same in every frame: for a camera that stands still, or a part of the robot.
            min_iou: Masks that the network judges to fit less are dropped, 0 to 1. A box then keeps the mask that the
                detector gave it, or none: whoever uses it makes one by depth.

        Raises:
            ConfigError: If there is neither a detector nor a prompt, or `min_iou` is out of range.
        """
        check_share("min_iou", min_iou)
        if detector is None and not prompts:
            raise ConfigError("prompts: expected a detector or prompts for every frame, got neither")
        self._segmenter, self._detector, self._prompts = segmenter, detector, tuple(prompts)
        self._min_iou = float(min_iou)

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find things in an RGB image; where there is nothing to prompt for, no network of masks runs.

        Raises:
            FrameError: If it is no such image.
            ConfigError: If a prompt for every frame is outside the image.
            ModelError: If a network fails.
            Exception: Whatever the detector raises.
        """
        check_image(image)
        found = no_detections() if self._detector is None else self._detector(image)
        self._check_prompts(image)
        boxes = np.clip(found.boxes, 0, np.tile(image.shape[1::-1], 2))
        rows = [row for row, box in enumerate(boxes) if (box[2:] - box[:2] >= 1).all()]
        asked = [prompt(found.labels[row], box=boxes[row]) for row in rows]
        masks, ious = self._segmenter(image, [*asked, *self._prompts])
        sure = (ious >= self._min_iou) & masks.any(axis=(1, 2))
        own = np.zeros((len(boxes), *image.shape[:2]), bool) if found.masks is None else found.masks.copy()
        for place, row in enumerate(rows):
            if sure[place]:
                own[row] = masks[place]
        kept = np.flatnonzero(sure[len(rows) :])
        names = tuple(self._prompts[number].label for number in kept)
        kept += len(rows)
        further = Detections(boxes_of(masks[kept]), np.clip(ious[kept], 0, 1), names, masks[kept], None)
        return joined(found._replace(masks=own), further)

    def _check_prompts(self, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        for each in self._prompts:
            if not ((each.points >= 0) & (each.points <= (width, height))).all():
                places = ", ".join(f"({x:g}, {y:g})" for x, y in each.points.tolist())
                raise ConfigError(f"prompt for {each.label}: expected points in {width}x{height} pixels, got {places}")


def joined(found: Detections, further: Detections) -> Detections:
    """Detections of one image, both with masks, the best first; of equal ones those of the first."""
    assert found.masks is not None  # as said
    assert further.masks is not None
    scores = np.concatenate([found.scores, further.scores])
    order = np.argsort(-scores, kind="stable")
    labels = found.labels + further.labels
    return Detections(
        np.concatenate([found.boxes, further.boxes])[order],
        scores[order],
        tuple(labels[row] for row in order),
        np.concatenate([found.masks, further.masks])[order],
        found.class_mask,
    )


def boxes_of(masks: np.ndarray) -> np.ndarray:
    """`(k, 4)` float32 left, top, right, bottom of masks `(k, h, w)` that are not empty."""
    boxes = [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] for rows, columns in map(np.nonzero, masks)]
    return np.array(boxes, np.float32).reshape(-1, 4)
