"""The platform of JAX, CPU or GPU: the tracker is made for the CPU."""

import logging
import os
import sys

_log = logging.getLogger(__name__)

_PLATFORMS, _CHOSEN_HERE = "JAX_PLATFORMS", "JAXSLAM_CHOSE_PLATFORM"
"""The last tells processes that this one starts that the first is not the user's."""


def prefer_cpu() -> None:
    """Have JAX compute on the CPU, unless `JAX_PLATFORMS` in the environment says otherwise; before JAX is imported."""
    if "jax" not in sys.modules and _PLATFORMS not in os.environ:
        os.environ |= {_PLATFORMS: "cpu", _CHOSEN_HERE: "1"}


def environment_of_user() -> dict[str, str]:
    """Return the environment without what `prefer_cpu` has put there, for programs that are not of jaxslam."""
    put_here = (_PLATFORMS, _CHOSEN_HERE) if _CHOSEN_HERE in os.environ else ()
    return {name: value for name, value in os.environ.items() if name not in put_here}


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
