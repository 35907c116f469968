"""EfficientSAM as its repository exports it: images of any size, points in their pixels.

Xiong et al., EfficientSAM (arXiv 2312.00863); `onnx_models.py` of github.com/yformer/EfficientSAM.
"""

from typing import ClassVar

import cv2
import numpy as np

from jaxslam.semantics.letterbox import Placement
from jaxslam.semantics.onnx_signature import Colors, Graph
from jaxslam.semantics.prompted.base import Arrays, Kinds, Points, PromptAdapter

_PATCH = 16  # pixels of what the network sees for one of its embedding


class EfficientSam(PromptAdapter):
    """In: RGB 0 to 1 of any size, which the graph stretches. Out: masks of the image's size.

    It knows no points beside a thing.
    """

    name: ClassVar[str] = "efficient_sam"
    interface: ClassVar[str] = (
        "batched_images -> image_embeddings; these, batched_point_coords, batched_point_labels, orig_im_size"
        " -> output_masks, iou_predictions"
    )
    points: ClassVar[str] = "batched_point_coords"
    kinds: ClassVar[str] = "batched_point_labels"
    outputs: ClassVar[tuple[tuple[str, ...], str]] = (("output_masks",), "iou_predictions")
    optional: ClassVar[tuple[str, ...]] = ("orig_im_size",)
    prompt_axis: ClassVar[int] = 1
    knows: ClassVar[tuple[int, ...]] = (1, 2, 3)

    @classmethod
    def fits(cls, encoder: Graph, decoder: Graph) -> bool:
        """By names; what the graph needs the size for is not done here."""
        return super().fits(encoder, decoder) and any(port.name == cls.size for port in decoder.inputs)

    def prepare(self, pixels: np.ndarray) -> tuple[np.ndarray, Placement]:
        """Keep the size where the encoder takes any, else stretch the image."""
        height, width = pixels.shape[:2]
        image = self.image
        if None in self.encoder.inputs[0].shape[-2:]:
            image = image._replace(width=width, height=height)
        resized = cv2.resize(pixels, image.size, interpolation=cv2.INTER_LINEAR)
        scale = (image.width / width, image.height / height)
        return image.tensor(resized, Colors(std=(255.0, 255.0, 255.0))), Placement((width, height), scale, (0, 0))

    def feed(self, embedding: Arrays, points: Points, kinds: Kinds, placement: Placement) -> dict[str, np.ndarray]:
        """The graph adds half a pixel to points once it has stretched them."""
        half = [0.5 * side / (_PATCH * cells) for side, cells in zip(placement.size, _cells(embedding), strict=True)]
        coordinates, kinds = self.padded(points - np.asarray(half, np.float32), kinds)
        size = np.array(placement.size[::-1])
        return {**embedding, self.points: coordinates[None], self.kinds: kinds[None], self.size: size}


def _cells(embedding: Arrays) -> tuple[int, int]:
    """Columns and rows."""
    rows, columns = embedding["image_embeddings"].shape[-2:]
    return columns, rows
