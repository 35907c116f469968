"""A promptable segmenter made of two ONNX files: the image is embedded once, and every prompt gets a mask."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from jaxslam.errors import ModelError, nearest
from jaxslam.semantics.detector import check_image, check_threads
from jaxslam.semantics.letterbox import Placement, plane_to_image
from jaxslam.semantics.onnx_session import Network, check_outputs
from jaxslam.semantics.prompted.base import Planes, PromptAdapter
from jaxslam.semantics.prompted.efficient_sam import EfficientSam
from jaxslam.semantics.prompted.prompt import Prompt, prompt
from jaxslam.semantics.prompted.sam import Sam, Sam2
from jaxslam.semantics.prompted.transformers_sam import TransformersSam

PROMPT_ADAPTERS: dict[str, type[PromptAdapter]] = {
    adapter.name: adapter for adapter in (Sam, Sam2, EfficientSam, TransformersSam)
}
"""All of them by name; no pair of graphs fits two."""

_SIDE = 1024  # of the encoder's input where it is open: what the networks of this family learnt from
_MAX_AT_ONCE = 16  # prompts: masks of whole images take room
_SAME = 1e-3  # of the largest logit: a batch may be computed in another order


class Embedding(NamedTuple):
    """An image as the decoder takes it.

    Attributes:
        values: By the names of the decoder's inputs.
        placement: Position of the image in the encoder's input.
    """

    values: dict[str, np.ndarray]
    placement: Placement


class Segments(NamedTuple):
    """Answers to prompts, in their order.

    Attributes:
        masks: `(k, h, w)` of the image's size, the best of those that the network offers.
        ious: `(k,)` how well each fits, as the network judges: about 0 to 1.
    """

    masks: Bool[np.ndarray, "k h w"]
    ious: Float32[np.ndarray, " k"]


class PromptSegmenter:
    """Segments what it is asked for. The same image and prompts give the same bytes."""

    def __init__(self, encoder: Network, decoder: Network, adapter: PromptAdapter) -> None:
        """Put together by `load_segmenter`."""
        self._encoder, self._decoder, self._adapter = encoder, decoder, adapter
        self.at_once = _MAX_AT_ONCE if adapter.takes_many and self._batches() else 1

    @property
    def adapter(self) -> str:
        """The name of the networks' family."""
        return self._adapter.name

    @property
    def paths(self) -> tuple[Path, Path]:
        """The files of encoder and decoder."""
        return self._encoder.path, self._decoder.path

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], prompts: Sequence[Prompt]) -> Segments:
        """Segment what prompts ask for in an RGB image of any size; the encoder runs once, if there is a prompt.

        Raises:
            FrameError: If it is no such image.
            ModelError: If a prompt holds what the network does not know, if it fails, or gives what it cannot mean.
        """
        check_image(image)
        if not prompts:
            return Segments(np.zeros((0, *image.shape[:2]), bool), np.zeros(0, np.float32))
        return self.segment(self.embed(image), prompts)

    def embed(self, image: UInt8[np.ndarray, "h w 3"]) -> Embedding:
        """An RGB image, ready for any number of prompts.

        Raises:
            FrameError: If it is no such image.
            ModelError: If the encoder fails, or gives numbers that are not finite.
        """
        check_image(image)
        tensor, placement = self._adapter.prepare(image)
        outputs = self._encoder.run(tensor)
        try:
            check_outputs(outputs, self._encoder.graph.outputs, varying=True)
            return Embedding(self._adapter.embedding(outputs), placement)
        except ModelError as error:
            raise ModelError(f"{self._encoder.path.name}: {error}") from None

    def segment(self, embedding: Embedding, prompts: Sequence[Prompt]) -> Segments:
        """Segment what prompts ask for in an image that is embedded.

        Raises:
            ModelError: If a prompt holds what the network does not know, if it fails, or gives what it cannot mean.
        """
        width, height = embedding.placement.size
        segments = Segments(np.zeros((len(prompts), height, width), bool), np.zeros(len(prompts), np.float32))
        for rows in _alike(prompts, self.at_once):
            planes = self._decoded(embedding, [prompts[row] for row in rows])
            best = planes.ious.argmax(axis=1)
            for place, row in enumerate(rows):
                mask = self._mask(planes, place, int(best[place]), embedding.placement)
                segments.masks[row] = mask if self._adapter.knows_boxes else _cut(mask, prompts[row])
                segments.ious[row] = planes.ious[place, best[place]]
        return segments

    def _decoded(self, embedding: Embedding, prompts: Sequence[Prompt]) -> Planes:
        """Run the decoder on prompts of one kind."""
        unknown = [kind for kind in prompts[0].kinds if kind not in self._adapter.knows]
        if unknown:
            raise ModelError(f"{self._decoder.path.name}: {self.adapter} knows no points beside a thing, got one")
        points, kinds = np.stack([each.points for each in prompts]), np.array([each.kinds for each in prompts])
        try:
            fed = self._adapter.feed(embedding.values, points, kinds, embedding.placement)
        except ModelError as error:
            raise ModelError(f"{self._decoder.path.name}: {error}") from None
        dtypes = {port.name: port.dtype for port in self._decoder.graph.inputs}
        outputs = self._decoder.feed({name: np.asarray(value, dtypes[name]) for name, value in fed.items()})
        named = {port.name: value for port, value in zip(self._decoder.graph.outputs, outputs, strict=True)}
        try:
            return self._adapter.read(named, len(prompts))
        except ModelError as error:
            raise ModelError(f"{self._decoder.path.name}: {error}") from None

    def _mask(self, planes: Planes, row: int, best: int, placement: Placement) -> np.ndarray:
        logits, (width, height) = np.ascontiguousarray(planes.logits[row, best]), placement.size
        if not planes.in_image:
            return plane_to_image(logits, self._adapter.image.size, placement) > 0
        if logits.shape != (height, width):
            expected = f"masks of the image's {width}x{height} pixels"
            raise ModelError(f"{self._decoder.path.name}: expected {expected}, got {logits.shape[1]}x{logits.shape[0]}")
        return logits > 0

    def _batches(self) -> bool:
        """Whether the decoder says the same to two prompts at once as to each: exports declare it, and do not always.

        Raises:
            ModelError: If it does not run for one prompt.
        """
        side = 64
        embedding = self.embed(np.zeros((side, side, 3), np.uint8))
        boxes = [prompt("", box=(8, 8, 40, 24)), prompt("", box=(20, 30, 60, 56))]
        single = [self._decoded(embedding, [box]).logits[0] for box in boxes]
        try:
            both = self._decoded(embedding, boxes).logits
        except ModelError:
            return False
        return all(np.allclose(a, b, rtol=0, atol=_SAME * abs(b).max()) for a, b in zip(both, single, strict=True))


def load_segmenter(
    encoder: str | os.PathLike[str],
    decoder: str | os.PathLike[str],
    *,
    adapter: str | None = None,
    num_threads: int = 1,
) -> PromptSegmenter:
    """Open two ONNX files as a promptable segmenter; their family is recognized from the graphs.

    Args:
        encoder: The file that takes the image.
        decoder: The file that takes what the first gives, and prompts.
        adapter: The family, where it shall not be recognized; see `PROMPT_ADAPTERS`.
        num_threads: Threads the networks may use.

    Raises:
        ConfigError: If the number of threads is out of range.
        ModelError: If a file is missing or damaged, if they are of no family, or not of the one named, or do not run.
    """
    check_threads(num_threads)
    if adapter is not None and adapter not in PROMPT_ADAPTERS:
        known = ", ".join(PROMPT_ADAPTERS)
        raise ModelError(f"adapter: expected one of {known}, got {adapter!r}{nearest(adapter, PROMPT_ADAPTERS)}")
    first, second = (Network(Path(path), num_threads, _SIDE) for path in (encoder, decoder))
    kinds = PROMPT_ADAPTERS if adapter is None else {adapter: PROMPT_ADAPTERS[adapter]}
    fitting = [kind for kind in kinds.values() if kind.fits(first.graph, second.graph)]
    if not fitting:
        families = "; ".join(f"{name}: {kind.interface}" for name, kind in kinds.items())
        raise ModelError(
            f"expected encoder and decoder of one of these families: {families}; got {first.path}: {first.graph};"
            f" {second.path}: {second.graph}"
        )
    return PromptSegmenter(first, second, fitting[0](first.graph, second.graph))


def _alike(prompts: Sequence[Prompt], most: int) -> Iterator[list[int]]:
    """Their numbers, so many at most at a time, those together that hold the same kinds of points."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for row, each in enumerate(prompts):
        groups.setdefault(each.kinds, []).append(row)
    for rows in groups.values():
        yield from (rows[start : start + most] for start in range(0, len(rows), most))


def _cut(mask: np.ndarray, asked: Prompt) -> np.ndarray:
    """A mask that ends where the box of its prompt does, if that has one."""
    if asked.box is None:
        return mask
    left, top, right, bottom = (max(round(edge), 0) for edge in asked.box)
    inside = np.zeros_like(mask)
    inside[top:bottom, left:right] = mask[top:bottom, left:right]
    return inside
