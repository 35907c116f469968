"""How often a function has been compiled, from jaxslam's register of compiled functions."""

from collections.abc import Callable
from typing import Any

from jaxslam.runtime.compiled import programs


def num_compiled(function: Callable[..., Any]) -> int:
    """Return the number of times that a function of `jaxslam.runtime.compiled` was compiled in this process."""
    name = f"{function.__module__}.{function.__qualname__}"
    (found,) = [entry for entry in programs if entry.name == name]
    return found.num_compiled
