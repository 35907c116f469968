"""Registry of the cues that the configuration can name, and their parameters from the configuration."""

import functools
import importlib
import pkgutil
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax.typing import DTypeLike

from jaxslam import dynamics
from jaxslam.config.cue_sections import MotionConfig
from jaxslam.config.schema import DynamicsConfig
from jaxslam.dynamics.cue import SettingsCue
from jaxslam.dynamics.object_motion import MotionParams, MotionPlan
from jaxslam.dynamics.regions import RegionPlan
from jaxslam.runtime.floating_dtype import floating_dtype
from jaxslam.tracking.state import TrackParams, TrackPlan


@functools.cache
def _known() -> dict[str, SettingsCue]:
    """Collect the cues that the modules `..._cue.py` of `jaxslam.dynamics` define, by name."""
    modules = [module.name for module in pkgutil.iter_modules(dynamics.__path__) if module.name.endswith("_cue")]
    cues: list[SettingsCue] = [importlib.import_module(f"{dynamics.__name__}.{name}").CUE for name in modules]
    return {cue.name: cue for cue in cues}


def with_cues(plan: TrackPlan, config: DynamicsConfig, *, pairs: bool = False) -> TrackPlan:
    """Add the configured cues to a plan, and regions if a cue needs them.

    Args:
        plan: The plan.
        config: Settings of the cues.
        pairs: Whether the frames are stereo pairs, whose depth and regions are computed at half the image size.
    """
    chosen, clusters = [_known()[name] for name in config.cues], config.clusters
    step_px = 2 * clusters.step_px if pairs else clusters.step_px
    recover_frames = config.learned.recover_frames if config.cues == ("learned",) else clusters.recover_frames
    regions = RegionPlan(clusters.num_regions, step_px, clusters.num_steps, recover_frames)
    needed = config.balance_regions or any(known.needs_regions for known in chosen)
    return plan._replace(
        cues=tuple(known.make(getattr(config, known.name)) for known in chosen),
        regions=regions if needed else None,
        balance_regions=config.balance_regions,
        motion=_motion_plan(config.motion),
        judge_masked=config.judge_masked,
    )


def with_cue_params(params: TrackParams, config: DynamicsConfig, dtype: DTypeLike | None = None) -> TrackParams:
    """Add the parameters of the configured cues to the tracker's parameters.

    Args:
        params: Parameters from `track_params`.
        config: Settings of the cues.
        dtype: Floating-point type of the added parameters; by default the type of `params`.

    Raises:
        ModelError: If the weights of the learned cue cannot be read.
        TypeError: If `dtype` is not a floating-point type, or is float64 while `jax_enable_x64` is off.
    """
    dtype = jnp.result_type(params.pixel_sigma) if dtype is None else floating_dtype(dtype)
    cues = tuple(_cue_params(_known()[name], config, dtype) for name in config.cues)
    motion = _params_of(config.motion, MotionParams, config, dtype) if config.motion.enabled else None
    return params._replace(cues=cues, motion=motion)


def _cue_params(cue: SettingsCue, config: DynamicsConfig, dtype: jnp.dtype) -> Any:
    section = getattr(config, cue.name)
    if cue.read_params is not None:
        return cue.read_params(section, config.temperature, dtype)
    return _params_of(section, cue.params, config, dtype)


def _motion_plan(config: MotionConfig) -> MotionPlan | None:
    if not config.enabled:
        return None
    return MotionPlan(config.num_objects, config.reserved, config.dense_cell_px, config.as_published)


def _params_of(chosen: Any, make: Callable[..., Any], config: DynamicsConfig, dtype: jnp.dtype) -> Any:
    fields: Any = make._fields  # type: ignore[attr-defined]
    values = {field: getattr(chosen, field) for field in fields if field != "temperature"}
    values["temperature"] = config.temperature
    return make(**{field: jnp.asarray(value, dtype) for field, value in values.items()})
