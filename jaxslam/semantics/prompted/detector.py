"""Use a promptable segmenter as a detector, with prompts from another detector or the same in every frame."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from jaxslam.errors import ConfigError
from jaxslam.semantics.detections import Detections, Detector, no_detections
from jaxslam.semantics.detector import check_image, check_share
from jaxslam.semantics.prompted.prompt import Prompt, prompt
from jaxslam.semantics.prompted.segmenter import PromptSegmenter


class PromptedDetector:
    """Detector that adds instance masks to the boxes of another detector, and to fixed prompts."""

    def __init__(
        self,
        segmenter: PromptSegmenter,
        detector: Detector | None = None,
        *,
        prompts: Sequence[Prompt] = (),
        min_iou: float = 0.5,
    ) -> None:
        """Combine a segmenter with the sources of its prompts.

        Args:
            segmenter: Segmenter that makes the masks.
            detector: Detector whose boxes are prompts; its class map is kept. `None` for fixed prompts alone.
            prompts: Prompts that are the same in every frame, for a static camera or a part of the robot.
            min_iou: Lowest IoU, 0 to 1, that the segmenter predicts for a mask. Below it, a box keeps the detector's
                mask or has none, and the caller makes one from depth.

        Raises:
            ConfigError: If there is neither a detector nor a prompt, or `min_iou` is out of range.
        """
        check_share("min_iou", min_iou)
        if detector is None and not prompts:
            raise ConfigError("prompts: expected a detector or prompts for every frame, got neither")
        self._segmenter, self._detector, self._prompts = segmenter, detector, tuple(prompts)
        self._min_iou = float(min_iou)

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find objects in an RGB image; the segmenter runs only if there are prompts.

        Raises:
            FrameError: If `image` is not such an image.
            ConfigError: If a prompt for every frame is outside the image.
            ModelError: If a network fails.
            Exception: Any error of the detector.
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
    """Merge detections of one image, both with masks, by falling score; ties keep the order of the arguments."""
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
    """Return the bounding boxes `(k, 4)` float32 of nonempty masks `(k, h, w)`."""
    boxes = [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] for rows, columns in map(np.nonzero, masks)]
    return np.array(boxes, np.float32).reshape(-1, 4)
