"""Playback of a recording at its own rate: a consumer slower than the camera misses frames, as on a robot."""

import time
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import TypeVar

import numpy as np

_Item = TypeVar("_Item")


def in_real_time(
    frames: Iterable[_Item],
    timestamps_ns: np.ndarray,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[_Item | None]:
    """Yield each frame when it is due; `None` for a late frame: its successor is due by the time it is requested.

    The first frame is due when it is requested. The last frame is never late.

    Args:
        frames: All frames in order, as `prefetch` yields them.
        timestamps_ns: `(n,)` timestamps of the frames in nanoseconds, increasing.
        clock: Function that returns the time in seconds.
        sleep: Function that waits for a number of seconds.
    """
    due_s = (np.asarray(timestamps_ns, np.int64) - timestamps_ns[0]) * 1e-9
    began = clock()
    for frame, (due, next_due) in zip(frames, pairwise([*due_s.tolist(), np.inf]), strict=True):
        passed = clock() - began
        if passed >= next_due:
            yield None
            continue
        if passed < due:
            sleep(due - passed)
        yield frame
