"""Interface of a family of promptable segmenters to `PromptSegmenter`: an image encoder and a prompt decoder."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float32, Int

from jaxslam.errors import ModelError
from jaxslam.semantics.letterbox import Fit, Placement, place
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput, Port
from jaxslam.semantics.prompted.prompt import NO_POINT

IMAGENET = Colors(mean=(123.675, 116.28, 103.53), std=(58.395, 57.12, 57.375))

Arrays: TypeAlias = Mapping[str, np.ndarray]
Points: TypeAlias = Float32[np.ndarray, "k n 2"]
Kinds: TypeAlias = Int[np.ndarray, "k n"]


class Planes(NamedTuple):
    """Answer of a decoder to `k` prompts: `m` masks for each to choose from.

    Attributes:
        logits: `(k, m, h, w)`, positive on the thing.
        ious: `(k, m)` how well each mask fits, as the network judges.
        in_image: Whether they are of the image's pixels; else they cover the encoder's whole input.
    """

    logits: np.ndarray
    ious: np.ndarray
    in_image: bool


class PromptAdapter(ABC):
    """One family; an instance is for two graphs that fit it.

    Attributes:
        name: Name in settings.
        interface: Inputs and outputs, for messages.
        fit: Way in which the image is fitted to the input of the encoder.
        embeddings: Inputs of the decoder that the encoder gives.
        points: The decoder's input of points; an axis before those of the points is that of prompts.
        kinds: Its input of what they are.
        outputs: The decoder's outputs: one of those of masks, and that of their scores.
        size: Its input of the image's height and width, where it has one.
        optional: Inputs of the decoder that it may have besides.
        prompt_axis: The axis of prompts.
        knows: Numbers of the points that it understands.
        knows_boxes: Whether boxes tell it where a thing ends; if not, its masks are cut off there.
        image: The encoder's input.
    """

    name: ClassVar[str]
    interface: ClassVar[str]
    fit: ClassVar[Fit] = "corner"
    embeddings: ClassVar[tuple[str, ...]] = ("image_embeddings",)
    points: ClassVar[str] = "point_coords"
    kinds: ClassVar[str] = "point_labels"
    outputs: ClassVar[tuple[tuple[str, ...], str]] = (("low_res_masks", "masks"), "iou_predictions")
    size: ClassVar[str] = "orig_im_size"
    optional: ClassVar[tuple[str, ...]] = ()
    prompt_axis: ClassVar[int] = 0
    knows: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)
    knows_boxes: ClassVar[bool] = True

    def __init__(self, encoder: Graph, decoder: Graph) -> None:
        """Prepare for two graphs that fit."""
        assert encoder.image is not None  # it fits
        self.encoder, self.decoder = encoder, decoder
        self.image: ImageInput = encoder.image
        self.inputs: dict[str, Port] = {port.name: port for port in decoder.inputs}

    @classmethod
    def fits(cls, encoder: Graph, decoder: Graph) -> bool:
        """Whether two graphs are of this family, by the names of inputs and outputs."""
        taken, given = ({port.name for port in ports} for ports in (decoder.inputs, decoder.outputs))
        masks, scores = cls.outputs
        needs = {*cls.embeddings, cls.points, cls.kinds}
        answers = scores in given and not given.isdisjoint(masks)
        return encoder.image is not None and needs <= taken <= needs | {*cls.optional} and answers

    @property
    def takes_many(self) -> bool:
        """Whether the decoder declares that it takes any number of prompts at once."""
        return self.inputs[self.points].shape[self.prompt_axis] is None

    def prepare(self, pixels: np.ndarray) -> tuple[np.ndarray, Placement]:
        """An RGB image as the encoder takes it, and where it lies in it.

        Where channels come last the graph normalizes; what is beside the image is 0 after that.
        """
        canvas, placement = place(pixels, self.image.size, self.fit, 0)
        values = canvas.astype(np.float32)
        width, height = (round(side * scale) for side, scale in zip(placement.size, placement.scale, strict=True))
        values[height:] = values[:, width:] = np.asarray(IMAGENET.mean, np.float32)
        return self.image.tensor(values, IMAGENET if self.image.channels_first else Colors()), placement

    def embedding(self, outputs: list[np.ndarray]) -> dict[str, np.ndarray]:
        """The encoder's outputs by the names of the decoder's inputs; a single one may have any name.

        Raises:
            ModelError: If one is not there.
        """
        named = {port.name: value for port, value in zip(self.encoder.outputs, outputs, strict=True)}
        if len(self.embeddings) == 1 and len(outputs) == 1:
            return {self.embeddings[0]: outputs[0]}
        missing = [name for name in self.embeddings if name not in named]
        if missing:
            raise ModelError(f"encoder: expected outputs {', '.join(self.embeddings)}, got {', '.join(named)}")
        return {name: named[name] for name in self.embeddings}

    @abstractmethod
    def feed(self, embedding: Arrays, points: Points, kinds: Kinds, placement: Placement) -> dict[str, np.ndarray]:
        """The decoder's inputs for prompts of one kind, all with as many points; their numbers are cast later.

        Args:
            embedding: Embedding of the image.
            points: In pixels of the image, from its corner.
            kinds: Kind of each point.
            placement: Position of the image in the encoder's input.
        """

    def read(self, outputs: Arrays, num_prompts: int) -> Planes:
        """Decode the outputs of the decoder.

        Raises:
            ModelError: If they are not masks and scores of so many prompts, or not finite.
        """
        masks = next(name for name in self.outputs[0] if name in outputs)
        logits, ious = (outputs[name].astype(np.float32, copy=False) for name in (masks, self.outputs[1]))
        for name, value in ((masks, logits), (self.outputs[1], ious)):
            if not np.isfinite(value).all():
                raise ModelError(f"output {name}: expected finite numbers, got some that are not")
        if logits.ndim == self.prompt_axis + 4 and ious.ndim == self.prompt_axis + 2 and ious.shape[-1]:
            lead = (1,) * self.prompt_axis + (num_prompts, ious.shape[-1])
            if logits.shape[:-2] == ious.shape == lead:
                in_image = masks != "low_res_masks" and self.size in self.inputs
                return Planes(logits.reshape(lead[-2:] + logits.shape[-2:]), ious.reshape(lead[-2:]), in_image)
        expected = f"masks and scores of {num_prompts} prompts"
        raise ModelError(
            f"outputs {masks} and {self.outputs[1]}: expected {expected}, got {logits.shape}, {ious.shape}"
        )

    def padded(self, points: Points, kinds: Kinds) -> tuple[Points, Kinds]:
        """Pad points to the number that the decoder takes, if that is fixed.

        Raises:
            ModelError: If there are more.
        """
        wanted, num = self.inputs[self.points].shape[-2] or points.shape[1], points.shape[1]
        if num > wanted:
            raise ModelError(f"input {self.points}: expected at most {wanted} points a prompt, got {num}")
        beyond = ((0, 0), (0, wanted - num))
        return np.pad(points, (*beyond, (0, 0))), np.pad(kinds, beyond, constant_values=NO_POINT)


def in_input(points: Points, placement: Placement) -> Points:
    """Points of the image as SAM takes them in its input: it counts from the center of the first pixel."""
    scale, offset = (np.asarray(pair, np.float32) for pair in (placement.scale, placement.offset))
    return points * scale + offset - np.float32(0.5)
