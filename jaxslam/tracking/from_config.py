"""The settings of the tracker as its programs take them, for a camera that measures depth or for a stereo pair."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jax.typing import DTypeLike

from jaxslam.config.schema import Config, TrackConfig
from jaxslam.runtime.floating_dtype import floating_dtype
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.sensor_model import max_valid_depth, sensor_model
from jaxslam.tracking.state import TrackParams, TrackPlan


def with_dense_keyframes(config: Config) -> TrackConfig:
    """The tracker's settings, with keyframes often enough for a dense map if there is to be one."""
    if not config.dense.enabled:
        return config.track
    return replace(config.track, keyframe_below=max(config.track.keyframe_below, config.dense.keyframe_below))


def track_plan(config: TrackConfig) -> TrackPlan:
    """The static part of the tracker's settings."""
    return TrackPlan(**{name: getattr(config, name) for name in TrackPlan._fields if hasattr(config, name)})


def track_params(camera: Camera, config: TrackConfig, dtype: DTypeLike = jnp.float32) -> TrackParams:
    """The traced part of the tracker's settings, with the camera; `track_step` takes it.

    Args:
        camera: That takes the frames.
        config: The tracker's settings.
        dtype: Floating-point type of every parameter, that of the state and the frames; float32 if not given, also
            with `jax_enable_x64`.

    Raises:
        TypeError: If `dtype` is no floating-point type, or is float64 while `jax_enable_x64` is off.
    """
    dtype = floating_dtype(dtype)
    max_speed_m_per_s = config.max_speed_m_per_s
    if camera.is_stereo:
        max_speed_m_per_s = max(max_speed_m_per_s, max_valid_depth(camera, config))
    names = [name for name in TrackParams._fields if name not in ("sensor", "cues", "motion")]
    settings = {name: getattr(config, name) for name in names} | {"max_speed_m_per_s": max_speed_m_per_s}
    arrays: dict[str, Any] = {name: jnp.asarray(value, dtype) for name, value in settings.items()}
    return TrackParams(sensor=sensor_model(camera, config, dtype), **arrays)
