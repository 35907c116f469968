"""Inputs and outputs of a network, by which adapters recognize it."""

from typing import NamedTuple

import cv2
import numpy as np

_FLOATS = ("float16", "float32", "float64")


class Port(NamedTuple):
    """An input or output of a network.

    Attributes:
        name: Name in the graph.
        shape: Size of each axis; `None` for a free size.
        dtype: NumPy type such as "float32", or onnxruntime's name of a type other than an array.
    """

    name: str
    shape: tuple[int | None, ...]
    dtype: str

    @property
    def is_float(self) -> bool:
        """Whether the type is a floating-point type."""
        return self.dtype in _FLOATS

    @property
    def is_integer(self) -> bool:
        """Whether the type is an integer type."""
        return self.dtype.removeprefix("u").startswith("int")

    def __str__(self) -> str:
        sizes = "x".join("?" if size is None else str(size) for size in self.shape)
        return f"{self.name} {self.dtype} {sizes or 'scalar'}"


class Colors(NamedTuple):
    """Normalization of image values for a network of floats: `(value - mean) / std` of 0 to 255."""

    bgr: bool = False
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)


class ImageInput(NamedTuple):
    """The input of a network that takes one image.

    Attributes:
        name: Name in the graph.
        width: Pixels.
        height: Pixels.
        channels_first: `(3, h, w)` rather than `(h, w, 3)`.
        batched: Whether there is an axis of length 1 before these.
        dtype: "float32", "uint8" and the like.
    """

    name: str
    width: int
    height: int
    channels_first: bool
    batched: bool
    dtype: str

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` in pixels."""
        return self.width, self.height

    def tensor(self, image: np.ndarray, colors: Colors) -> np.ndarray:
        """An RGB image of the input's size as the network takes it; whole numbers stay 0 to 255."""
        pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if colors.bgr else image
        if self.dtype != "uint8":
            mean, std = (np.asarray(values, np.float32) for values in colors[1:])
            pixels = (pixels.astype(np.float32) - mean) / std
        if self.channels_first:
            pixels = pixels.transpose(2, 0, 1)
        return np.ascontiguousarray(pixels[None] if self.batched else pixels, self.dtype)


class Graph(NamedTuple):
    """Inputs, outputs and metadata of a network.

    Attributes:
        image: Its input; `None` if it is not one image.
        inputs: Declared inputs.
        outputs: With the sizes they had for an empty image.
        names: The names of its classes, where its metadata holds them.
    """

    image: ImageInput | None
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    names: tuple[str, ...] | None

    def __str__(self) -> str:
        inputs, outputs = ("; ".join(map(str, ports)) or "none" for ports in (self.inputs, self.outputs))
        return f"inputs: {inputs}; outputs: {outputs}; class names: {len(self.names) if self.names else 'none'}"


def image_input(inputs: tuple[Port, ...], free_size: int) -> ImageInput | None:
    """The one image that a network takes, if that is what it takes.

    Args:
        inputs: All its inputs.
        free_size: Width and height where they are not fixed, pixels.
    """
    if len(inputs) != 1 or not (inputs[0].is_float or inputs[0].dtype == "uint8"):
        return None
    name, shape, dtype = inputs[0]
    batched = len(shape) == 4
    if len(shape) not in (3, 4) or (batched and shape[0] not in (1, None)):
        return None
    sizes = shape[-3:]
    channels_first = sizes[0] == 3
    if not channels_first and sizes[2] != 3:
        return None
    height, width = (size or free_size for size in (sizes[1:] if channels_first else sizes[:2]))
    return ImageInput(name, width, height, channels_first, batched, dtype)
