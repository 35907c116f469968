"""A recording at the rate it was taken at: who is slower than the camera misses frames, as on a robot."""

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
    """Each frame when it is due; `None` for one that is late, because the next one is there when it is asked for.

    The first frame is due when it is asked for. The last one is never late.

    Args:
        frames: All frames in order, as `prefetch` gives them.
        timestamps_ns: `(n,)` their times, increasing.
        clock: Gives seconds.
        sleep: Waits for some.
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
