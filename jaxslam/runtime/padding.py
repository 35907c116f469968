"""Arrays brought to the few sizes that programs are compiled for."""

from typing import Any

import numpy as np


def padded(array: np.ndarray, size: int, *, axis: int = 0, fill: Any = 0) -> np.ndarray:
    """`array` filled up to `size` along `axis`, with a number or with what broadcasts to one entry."""
    shape = list(array.shape)
    shape[axis] = size - shape[axis]
    return np.concatenate([array, np.broadcast_to(np.asarray(fill, array.dtype), shape)], axis=axis)
