"""Guards the calls of a tracker: one at a time, and none in a process that was made by `fork`."""

import os
import threading
from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from jax._src import xla_bridge  # nothing public tells whether JAX has begun to compute

_P = ParamSpec("_P")
_R = TypeVar("_R")

_parent_computes = False
"""Whether JAX had begun to compute when this process was last about to fork."""
_forked = False
"""Whether this process was forked from one in which JAX had begun to compute."""


def _before_fork() -> None:
    """Ask JAX in the parent: it takes a lock, which another thread may hold, and in the child forever."""
    global _parent_computes  # noqa: PLW0603 - a fact about the process
    _parent_computes = xla_bridge.backends_are_initialized()


def _in_child() -> None:
    global _forked  # noqa: PLW0603 - a fact about the process
    _forked = _forked or _parent_computes


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(before=_before_fork, after_in_child=_in_child)


def refuse_after_fork() -> None:
    """Refuse to compute in a process that was forked from one in which JAX had computed; there JAX would hang.

    JAX starts threads that a forked process does not have, and locks that they held stay locked in it.

    Raises:
        RuntimeError: If this is such a process.
    """
    if _forked:
        raise RuntimeError(
            "jaxslam cannot compute in a process that was forked from one where JAX has computed: it would hang;"
            " start the process by multiprocessing.get_context('spawn')"
        )


class Guarded(Protocol):
    """An object whose guarded methods take turns.

    Attributes:
        call_lock: The lock that a guarded method holds while it runs.
    """

    call_lock: threading.RLock


_S = TypeVar("_S", bound=Guarded)


def one_at_a_time(method: Callable[Concatenate[_S, _P], _R]) -> Callable[Concatenate[_S, _P], _R]:
    """Make a method wait for calls of guarded methods in other threads, and refuse to run after a fork."""

    @wraps(method)
    def guarded(self: _S, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        refuse_after_fork()  # before the lock, which a thread of the parent may have held
        with self.call_lock:
            return method(self, *args, **kwargs)

    return guarded
