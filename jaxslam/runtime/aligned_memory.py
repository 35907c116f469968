"""Memory that XLA computes on in place."""

import math

import numpy as np
from numpy.typing import DTypeLike

_ALIGNMENT = 64  # bytes


def aligned_array(shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """An array, of whatever values, that begins at a multiple of 64 bytes.

    XLA computes on such arrays in place, in the calling thread; others it copies in a thread of its own, where the
    call then waits for what other threads have XLA do.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.empty(size + _ALIGNMENT, np.uint8)
    begin = -room.ctypes.data % _ALIGNMENT
    return room[begin : begin + size].view(dtype).reshape(shape)
