"""The cues that settings can name, and their parameters as the settings have them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.config import DynamicsConfig
from jaxslam.dynamics.cue import Cue
from jaxslam.dynamics.trajectory import TrajectoryParams, trajectory_cue


class _Known(NamedTuple):
    """A cue, and what makes its parameters of settings, all of one floating-point type."""

    cue: Cue
    params: Callable[[DynamicsConfig, type[np.floating]], Any]


def _trajectory_params(config: DynamicsConfig, dtype: type[np.floating]) -> TrajectoryParams:
    chosen = config.trajectory
    return TrajectoryParams(
        tolerance_m=jnp.asarray(chosen.tolerance_m, dtype),
        tolerance_per_m=jnp.asarray(chosen.tolerance_per_m, dtype),
        as_published=jnp.asarray(chosen.as_published),
        temperature=jnp.asarray(config.temperature, dtype),
    )


_KNOWN = {"trajectory": _Known(trajectory_cue, _trajectory_params)}


def cues_of(config: DynamicsConfig) -> tuple[Cue, ...]:
    """The cues of the settings, for `TrackPlan.cues`."""
    return tuple(_KNOWN[name].cue for name in config.cues)


def cue_params_of(config: DynamicsConfig, dtype: type[np.floating] = np.float32) -> tuple[Any, ...]:
    """Their parameters, for `TrackParams.cues`."""
    return tuple(_KNOWN[name].params(config, dtype) for name in config.cues)
