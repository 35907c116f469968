"""Aligned arrays, which XLA reads in place instead of copying them."""

import math

import numpy as np
from numpy.typing import DTypeLike

_ALIGNMENT = 64  # bytes


def aligned_array(shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """Allocate an uninitialized array whose address is a multiple of 64 bytes.

    XLA computes on such an array in place, in the calling thread. It copies any other array in a thread of its own, and
    the call then waits behind the work that other threads have given to XLA.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.empty(size + _ALIGNMENT, np.uint8)
    begin = -room.ctypes.data % _ALIGNMENT
    return room[begin : begin + size].view(dtype).reshape(shape)
