"""Convert the configuration to the tracker's plan and parameters, for a depth camera or a stereo pair."""

from dataclasses import replace

import jax.numpy as jnp
from jax.typing import DTypeLike

from jaxslam.config.schema import Config, TrackConfig
from jaxslam.runtime.floating_dtype import floating_dtype
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.sensor_model import max_valid_depth, sensor_model
from jaxslam.tracking.state import TrackParams, TrackPlan


def with_dense_keyframes(config: Config) -> TrackConfig:
    """Return the tracker's settings, with keyframes frequent enough for the dense map if it is enabled."""
    if not config.dense.enabled:
        return config.track
    return replace(config.track, keyframe_below=max(config.track.keyframe_below, config.dense.keyframe_below))


def track_plan(config: TrackConfig) -> TrackPlan:
    """Convert the static part of the tracker's settings."""
    return TrackPlan(
        num_points=config.num_points,
        num_levels=config.num_levels,
        num_keyframes=config.num_keyframes,
        num_reloaded=config.num_reloaded,
        num_sources=config.num_sources,
        points_per_source=config.points_per_source,
        num_hypotheses=config.num_hypotheses,
        cell_px=config.cell_px,
        new_points=config.new_points,
        keyframe_policy=config.keyframe_policy,
    )


def track_params(camera: Camera, config: TrackConfig, dtype: DTypeLike = jnp.float32) -> TrackParams:
    """Convert the traced part of the tracker's settings, and the camera, to parameters of `track_step`.

    Args:
        camera: Camera of the frames.
        config: Settings of the tracker.
        dtype: Floating-point type of every parameter, equal to that of the state and the frames; float32 by default,
            also with `jax_enable_x64`.

    Raises:
        TypeError: If `dtype` is not a floating-point type, or is float64 while `jax_enable_x64` is off.
    """
    dtype = floating_dtype(dtype)
    max_speed_m_per_s = config.max_speed_m_per_s
    if max_speed_m_per_s is None:
        max_speed_m_per_s = max_valid_depth(camera, config)
    of = lambda value: jnp.asarray(value, dtype)
    return TrackParams(
        sensor=sensor_model(camera, config, dtype),
        pixel_sigma=of(config.pixel_sigma),
        loss_scale=of(config.loss_scale),
        ransac_px=of(config.ransac_px),
        outlier_px=of(config.outlier_px),
        error_per_flow=of(config.error_per_flow),
        min_correlation=of(config.min_correlation),
        min_inliers=of(config.min_inliers),
        weak_inliers=of(config.weak_inliers),
        min_share=of(config.min_share),
        detect_below=of(config.detect_below),
        keyframe_below=of(config.keyframe_below),
        keyframe_followed_below=of(config.keyframe_followed_below),
        keyframe_views=of(config.keyframe_views),
        map_views=of(0),
        map_changed=of(0),
        keyframe_points_below=of(config.keyframe_points_below),
        keyframe_weak_after_s=of(config.keyframe_weak_after_s),
        keyframe_min_s=of(config.keyframe_min_s),
        keyframe_motion=of(config.keyframe_motion),
        keyframe_movable_below=of(config.keyframe_movable_below),
        keyframe_patience_s=of(config.keyframe_patience_s),
        probation_frames=of(config.probation_frames),
        anchor_frames=of(config.anchor_frames),
        restart_after=of(config.restart_after),
        max_speed_m_per_s=of(max_speed_m_per_s),
        max_turn_rad_per_s=of(config.max_turn_rad_per_s),
    )
