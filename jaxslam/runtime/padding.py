"""Pad arrays to the few sizes that programs are compiled for."""

from typing import Any

import numpy as np


def padded(array: np.ndarray, size: int, *, axis: int = 0, fill: Any = 0) -> np.ndarray:
    """Pad `array` at its end to `size` along `axis`.

    Args:
        array: The array, no longer than `size` along `axis`.
        size: Length of the result along `axis`.
        axis: The axis to pad.
        fill: Value of the added entries: a number, or an array that broadcasts to them.
    """
    shape = list(array.shape)
    shape[axis] = size - shape[axis]
    return np.concatenate([array, np.broadcast_to(np.asarray(fill, array.dtype), shape)], axis=axis)
