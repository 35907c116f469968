"""SAM as its authors export it, and what has the same decoder: MobileSAM and others; SAM 2 as samexporter exports it.

Kirillov et al., Segment Anything (arXiv 2304.02643); names and meaning of inputs as in `segment_anything/utils/onnx.py`
of github.com/facebookresearch/segment-anything. Ravi et al., SAM 2 (arXiv 2408.00714); `export_sam2.py` of
github.com/vietanhdev/samexporter.
"""

from typing import ClassVar

import numpy as np

from jaxslam.semantics.letterbox import Fit, Placement
from jaxslam.semantics.prompted.base import Arrays, Kinds, Points, PromptAdapter, in_input
from jaxslam.semantics.prompted.prompt import NO_POINT, TOP_LEFT

_MASK_STEP = 4  # a mask given as a prompt is so much finer than the embedding


class Sam(PromptAdapter):
    """In: 1x3xHxW, normalized by ImageNet, or HxWx3, 0 to 255, which the graph normalizes; the image in the corner.

    Masks are read from `low_res_masks`, which cover the whole input: exports of `masks` may have the shape of the image
    they were made with written into them.
    """

    name: ClassVar[str] = "sam"
    interface: ClassVar[str] = (
        "image -> image_embeddings; point_coords, point_labels (mask_input, has_mask_input, orig_im_size)"
        " -> masks or low_res_masks, iou_predictions"
    )
    optional: ClassVar[tuple[str, ...]] = ("mask_input", "has_mask_input", "orig_im_size")

    def feed(self, embedding: Arrays, points: Points, kinds: Kinds, placement: Placement) -> dict[str, np.ndarray]:
        """Without a box, SAM expects one row that is no point."""
        coordinates = in_input(points, placement)
        if TOP_LEFT not in kinds[0]:
            coordinates = np.pad(coordinates, ((0, 0), (0, 1), (0, 0)))
            kinds = np.pad(kinds, ((0, 0), (0, 1)), constant_values=NO_POINT)
        return self._fed(embedding, coordinates, kinds, placement)

    def _fed(self, embedding: Arrays, coordinates: Points, kinds: Kinds, placement: Placement) -> dict[str, np.ndarray]:
        coordinates, kinds = self.padded(coordinates, kinds)
        fed = {**embedding, self.points: coordinates, self.kinds: kinds}
        if "mask_input" in self.inputs:
            num = self.inputs["mask_input"].shape[0] or len(coordinates)
            sides = (_MASK_STEP * side for side in embedding[self.embeddings[-1]].shape[-2:])
            fed["mask_input"] = np.zeros((num, 1, *sides), np.float32)
        if "has_mask_input" in self.inputs:
            fed["has_mask_input"] = np.zeros(1, np.float32)
        if self.size in self.inputs:
            fed[self.size] = np.array(placement.size[::-1])
        return fed


class Sam2(Sam):
    """In: 1x3xHxW, normalized by ImageNet, stretched; the graph itself adds the row that is no point."""

    name: ClassVar[str] = "sam2"
    interface: ClassVar[str] = (
        "image -> high_res_feats_0, high_res_feats_1, image_embed; these, point_coords, point_labels"
        " (mask_input, has_mask_input, orig_im_size) -> masks or low_res_masks, iou_predictions"
    )
    fit: ClassVar[Fit] = "stretch"
    embeddings: ClassVar[tuple[str, ...]] = ("high_res_feats_0", "high_res_feats_1", "image_embed")

    def feed(self, embedding: Arrays, points: Points, kinds: Kinds, placement: Placement) -> dict[str, np.ndarray]:
        """Return the inputs of the decoder, with points in pixels of the encoder's input."""
        return self._fed(embedding, in_input(points, placement), kinds, placement)
