"""How many programs a function of `jaxslam.runtime.compiled` has been compiled to."""

from typing import Any


def num_compiled(function: Any) -> int:
    """Return the number of programs, also of one trace: arrays that are committed to a device make another one.

    The register counts traces, and would miss that.
    """
    program = function._program() if hasattr(function, "_program") else function
    return program._cache_size()
