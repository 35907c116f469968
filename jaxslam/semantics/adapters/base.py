"""Interface of a family of networks to the detector."""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from jaxslam.semantics.detections import Detections
from jaxslam.semantics.letterbox import Fit, Placement, boxes_to_image, place
from jaxslam.semantics.onnx_signature import Colors, Graph, ImageInput
from jaxslam.semantics.postprocess import Candidates, Wanted, choose


class Adapter(ABC):
    """One family of networks; an instance is for one graph that fits it.

    Attributes:
        name: Name in settings.
        interface: Its outputs, for messages.
        varying: Whether the sizes of outputs depend on the image.
        fit: Way in which the image is fitted to the input.
        pad: Value of the pixels beside it.
        colors: Order and scale of the color values in the input.
        image: The graph's input.
        graph: The graph.
        names: Every class by number; empty where a number has none.
    """

    name: ClassVar[str]
    interface: ClassVar[str]
    varying: ClassVar[bool] = False
    fit: ClassVar[Fit] = "stretch"
    pad: ClassVar[int] = 114
    colors: Colors = Colors()

    def __init__(self, graph: Graph, image: ImageInput) -> None:
        """Prepare for a graph that fits."""
        self.graph, self.image = graph, image
        names = self.names_of(graph, image)
        assert names is not None  # it fits
        self.names = names

    @classmethod
    def fits(cls, graph: Graph) -> bool:
        """Whether a graph is of this family."""
        return graph.image is not None and cls.names_of(graph, graph.image) is not None

    @classmethod
    @abstractmethod
    def names_of(cls, graph: Graph, image: ImageInput) -> tuple[str, ...] | None:
        """The names of a graph's classes; `None` if it is not of this family, or they cannot be known."""

    def prepare(self, pixels: np.ndarray) -> tuple[np.ndarray, Placement]:
        """An RGB image as the network takes it, and where it lies in it."""
        canvas, placement = place(pixels, self.image.size, self.fit, self.pad)
        return self.image.tensor(canvas, self.colors), placement

    @abstractmethod
    def decode(self, outputs: list[np.ndarray], placement: Placement, wanted: Wanted) -> Detections:
        """Decode the outputs of the network.

        Args:
            outputs: Outputs of the network, of the expected shapes and finite.
            placement: Position of the image in the input.
            wanted: Labels and scores to keep.

        Raises:
            ModelError: If they hold what they cannot mean.
        """


class BoxAdapter(Adapter):
    """A family that finds boxes, and nothing else."""

    @abstractmethod
    def candidates(self, outputs: list[np.ndarray], wanted: Wanted) -> Candidates:
        """The boxes it proposes, in pixels of the input; those that will not be kept may be left out."""

    def decode(self, outputs: list[np.ndarray], placement: Placement, wanted: Wanted) -> Detections:
        """The best of what it proposes."""
        return found(choose(self.candidates(outputs, wanted), wanted), placement, wanted.names)


def found(
    kept: Candidates, placement: Placement, names: tuple[str, ...], masks: np.ndarray | None = None
) -> Detections:
    """Boxes that are kept as detections in the image."""
    labels = tuple(names[index] for index in kept.classes)
    return Detections(boxes_to_image(kept.boxes, placement), kept.scores, labels, masks, None)
