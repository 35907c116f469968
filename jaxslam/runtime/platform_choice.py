"""The platform of JAX, CPU or GPU: the tracker is made for the CPU."""

import logging
import os
import sys

_log = logging.getLogger(__name__)


def prefer_cpu() -> None:
    """Have JAX compute on the CPU, unless `JAX_PLATFORMS` in the environment says otherwise; before JAX is imported."""
    if "jax" not in sys.modules:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")


def warn_unless_cpu() -> None:
    """Log a warning if JAX computes elsewhere: compiling took 110 s on an H200, and 14 s on the CPU beside it."""
    import jax  # noqa: PLC0415 - `prefer_cpu` must come before

    platform = jax.default_backend()
    if platform != "cpu":
        _log.warning(
            "JAX computes on '%s'; expected 'cpu', where tracking starts and runs much faster. "
            "Set JAX_PLATFORMS=cpu before JAX is imported.",
            platform,
        )
