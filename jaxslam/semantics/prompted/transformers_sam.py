"""SAM as transformers and Optimum export it: SlimSAM, `Xenova/sam-vit-base` and the like.

Names as in `prompt_encoder_mask_decoder.onnx`. These exports have points, but no boxes.
"""

from typing import ClassVar

import numpy as np

from jaxslam.semantics.letterbox import Placement
from jaxslam.semantics.prompted.base import Arrays, Kinds, Points, PromptAdapter, in_input
from jaxslam.semantics.prompted.prompt import BOTTOM_RIGHT, ON, TOP_LEFT


class TransformersSam(PromptAdapter):
    """In: 1x3xHxW, normalized by ImageNet, the image in the corner. A box is asked for by the point in its middle."""

    name: ClassVar[str] = "transformers_sam"
    interface: ClassVar[str] = (
        "pixel_values -> image_embeddings, image_positional_embeddings; these, input_points, input_labels"
        " -> pred_masks, iou_scores"
    )
    embeddings: ClassVar[tuple[str, ...]] = ("image_embeddings", "image_positional_embeddings")
    points: ClassVar[str] = "input_points"
    kinds: ClassVar[str] = "input_labels"
    outputs: ClassVar[tuple[tuple[str, ...], str]] = (("pred_masks",), "iou_scores")
    prompt_axis: ClassVar[int] = 1
    knows_boxes: ClassVar[bool] = False

    def feed(self, embedding: Arrays, points: Points, kinds: Kinds, placement: Placement) -> dict[str, np.ndarray]:
        """Points, and one for the box."""
        if TOP_LEFT in kinds[0]:
            points, kinds = _with_middle(points, kinds)
        coordinates, kinds = self.padded(in_input(points, placement), kinds)
        return {**embedding, self.points: coordinates[None], self.kinds: kinds[None]}


def _with_middle(points: Points, kinds: Kinds) -> tuple[Points, Kinds]:
    corners = np.isin(kinds[0], (TOP_LEFT, BOTTOM_RIGHT))
    middle = points[:, corners].mean(axis=1, keepdims=True)
    kept = kinds[:, ~corners]
    if (kept == ON).any():  # a point of the thing says more than the middle of its box
        return points[:, ~corners], kept
    return np.concatenate([points[:, ~corners], middle], axis=1), np.pad(kept, ((0, 0), (0, 1)), constant_values=ON)
