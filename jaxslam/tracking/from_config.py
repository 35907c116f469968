"""The settings of the tracker as its programs take them, for a camera that measures depth or for a stereo pair."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike

from jaxslam.config.schema import Config, TrackConfig
from jaxslam.sensors.camera import Camera
from jaxslam.tracking.floating_dtype import floating_dtype
from jaxslam.tracking.state import TrackParams, TrackPlan


class DepthNoise(NamedTuple):
    """Standard deviation of depth: `sigma_m + sigma_per_m2 z^2`.

    Attributes:
        sigma_m: Close to the camera, meters.
        sigma_per_m2: Its growth with the square of depth, a meter.
    """

    sigma_m: float
    sigma_per_m2: float


def depth_noise(camera: Camera, config: TrackConfig) -> DepthNoise:
    """That of the sensor in the settings; of a stereo pair that of its disparity, to first order."""
    if camera.baseline_m is None or not camera.is_stereo:
        return DepthNoise(config.depth_sigma_m, config.depth_sigma_per_m2)
    return DepthNoise(0.0, config.disparity_sigma_px / (camera.fx * camera.baseline_m))


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
    noise = depth_noise(camera, config)
    by_camera: dict[str, float] = {
        "readout_s": camera.readout_s,
        "baseline_m": 0.0,
        "depth_sigma_m": noise.sigma_m,
        "depth_sigma_per_m2": noise.sigma_per_m2,
    }
    if camera.baseline_m is not None and camera.is_stereo:
        farthest_m = camera.far_depth_m or config.far_baselines * camera.baseline_m
        by_camera |= {
            "baseline_m": camera.baseline_m,
            "max_depth_m": farthest_m,
            "max_speed_m_per_s": max(config.max_speed_m_per_s, farthest_m),
        }
    names = [name for name in TrackParams._fields if name not in ("intrinsics", "cues", "motion")]
    settings = {name: by_camera[name] if name in by_camera else getattr(config, name) for name in names}
    arrays: dict[str, Any] = {name: jnp.asarray(value, dtype) for name, value in settings.items()}
    return TrackParams(intrinsics=camera.intrinsics(dtype), **arrays)
