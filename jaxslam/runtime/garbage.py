"""Limits on Python's garbage collector: pauses for work that makes many objects, and older objects left alone."""

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_lock = threading.Lock()
_num_pauses = 0
_was_enabled = False


@contextmanager
def collector_paused() -> Iterator[None]:
    """Keep Python's cyclic garbage collector from running, in all threads; pauses may overlap.

    Tracing a program makes so many objects that the collector walks through everything that has been imported again and
    again: 0.7 of the 8.4 s to the first pose. Reference counting frees what it frees as ever. A collector that was
    disabled before stays so.
    """
    global _num_pauses, _was_enabled  # noqa: PLW0603 - one collector for the process
    with _lock:
        if _num_pauses == 0:
            _was_enabled = gc.isenabled()
            gc.disable()
        _num_pauses += 1
    try:
        yield
    finally:
        with _lock:
            _num_pauses -= 1
            if _num_pauses == 0 and _was_enabled:
                gc.enable()


_FROZEN_BY_PYTHON = 1000
"""More objects than Python itself freezes as it starts: 375 in Python 3.12."""


@contextmanager
def garbage_frozen() -> Iterator[None]:
    """Keep the garbage collector away from older objects: scanning all of them takes 0.3 s of a frame.

    Python thaws all objects or none: in a program that has frozen its own, these stay frozen too.
    """
    is_own = gc.get_freeze_count() < _FROZEN_BY_PYTHON
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        if is_own:
            gc.unfreeze()
