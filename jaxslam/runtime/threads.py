"""Threads of this process: how many XLA, OpenCV and BLAS compute with, and how soon those of Python give way."""

import logging
import os
import sys

_log = logging.getLogger(__name__)

_chosen_here: int | None = None
"""Number that this module wrote to `NPROC`; `None` while that is the user's, or not set."""
_SWITCH_S = 2e-4
_told = False
"""Whether this process has been told that XLA has other threads than were asked for."""


def bound_threads(number: int) -> None:
    """Bound the threads of XLA, OpenCV and BLAS, each to the same number.

    XLA takes a number once, at the first array of the process; if it has another one by then, one warning says so.
    `NPROC` in the environment outranks the number for XLA.

    Each thread of Python computes by itself: dispatched asynchronously, programs would wait in one queue for XLA's
    threads. Beside a thread that is always computing, 95 of 100 frames take 8.5 ms at most, and 12.4 ms where XLA has
    two threads and a queue (AMD EPYC, two cores). OpenCV with one thread instead of two takes 3 ms from that figure of
    a stereo pair, 24 ms instead of 27, and nothing of other frames.

    Args:
        number: Number of threads, at least one.
    """
    import cv2  # noqa: PLC0415 - `usable_cores` needs neither

    _bound_xla(number)
    cv2.setNumThreads(number)
    bound_blas(number)


def bound_blas(number: int) -> None:
    """Bound the threads of the BLAS libraries that NumPy and SciPy have loaded by now.

    OpenBLAS starts one for each core, and they spin while they wait for work. Live tracking of KITTI 06 took 99 ms of
    processor time a frame with two of them instead of 46, and 17.7 ms of wall time in the median instead of 15.2 (means
    of three runs in turn, AMD EPYC, two cores).

    Args:
        number: Number of threads, at least one.
    """
    from threadpoolctl import threadpool_limits  # noqa: PLC0415

    threadpool_limits(number, user_api="blas")


def prefer_one_thread() -> None:
    """Have XLA compute in the calling thread, unless `NPROC` in the environment says otherwise; before the first array.

    `Slam` does it when it begins (`run.threads`). Call it where your program makes arrays before.

    With more threads XLA splits work that is too small for it, and waits for the parts; `bound_threads` has figures.
    """
    _bound_xla(1)


def start_with_one_thread() -> None:
    """Have XLA compute in the calling thread if JAX has not begun to compute, as `Slam` does; say nothing if it has."""
    from jax._src import xla_bridge  # noqa: PLC0415 - nothing public tells whether JAX has begun to compute

    if not xla_bridge.backends_are_initialized():
        _bound_xla(1)


def shorten_switch_interval() -> None:
    """Have Python's threads give way to each other after 0.2 ms instead of 5, in the whole process; never later.

    Tracking waits for the interpreter after every compiled program, while mapping computes in NumPy. With 5 ms frames
    of a turning camera take 20.2 ms in the median and 31.4 at the 95th percentile, with 0.2 ms 18.9 and 29.4 (fr1_rpy
    at 30 Hz, means of three runs in turn, AMD EPYC, two cores).
    """
    sys.setswitchinterval(min(sys.getswitchinterval(), _SWITCH_S))


def threads() -> int:
    """Return the number of threads XLA computes with, if `NPROC` is now what it was at the first array."""
    chosen = os.environ.get("NPROC", "")
    return int(chosen) if chosen.isdigit() and int(chosen) > 0 else usable_cores()


def usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _bound_xla(number: int) -> None:
    """Set the number of XLA's threads, or warn if it is too late and they are others."""
    global _chosen_here, _told  # noqa: PLW0603 - facts about the process
    import jax  # noqa: PLC0415
    from jax._src import xla_bridge  # noqa: PLC0415 - nothing public tells whether JAX has begun to compute

    is_free = "NPROC" not in os.environ or os.environ["NPROC"] == str(_chosen_here)
    if not xla_bridge.backends_are_initialized():
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        if is_free:
            os.environ["NPROC"], _chosen_here = str(number), number
        return
    queued: bool = jax.config.values["jax_cpu_enable_async_dispatch"]
    if not _told and (queued or (is_free and threads() != number)):
        _told = True
        _log.warning(
            "XLA computes with %d threads%s since the first array of this process, not with run.threads=%d: frames may"
            " take longer; call jaxslam.prefer_one_thread() before the first array",
            *(threads(), " and one queue" if queued else "", number),
        )
