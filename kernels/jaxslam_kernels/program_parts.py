"""Parts of a compiled program that XLA keeps apart."""

from collections.abc import Callable
from typing import TypeVar

import jax
from jax.experimental.xla_metadata import set_xla_metadata

T = TypeVar("T")


def apart(compute: Callable[[], T]) -> T:
    """Compute something once, whatever uses it.

    XLA's CPU backend fuses what is cheap into all of its uses and computes it again in each, which makes programs long:
    a depth that is sampled, a mask, or a projection stood up to eight times in the tracker's step. Here it becomes a
    computation of its own, which is called. `lax.optimization_barrier` does not help, since XLA drops it before fusion.

    It also keeps a program in its thread. Of more than nine parts that could run at once, XLA hands half to its pool of
    threads, where they may wait for other programs; what is called counts as one.

    Values and derivatives are those of `compute`; where XLA does not know the hint, only the program is longer.

    Args:
        compute: Function without arguments; the arrays it closes over may be traced.
    """
    with set_xla_metadata(inlineable="false"):
        return jax.jit(compute)()
