"""Samples for the learned cue: what its network sees of points while scenes are tracked, with what is true of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.types import Pixels
from jaxtyping import Array, Bool, Float, Int

from jaxslam.config.loading import load_config
from jaxslam.dynamics.cue import Cue, CueInput, CueResult
from jaxslam.dynamics.learned_cue import LearnedFeatures, LearnedParams, learned_cue, learned_features
from jaxslam.dynamics.regions import of_points
from jaxslam.learning.labeled_scene import LabeledScene
from jaxslam.learning.losses import ate_loss
from jaxslam.runtime.compiled import committed, compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.tracking.cue_registry import with_cue_params, with_cues
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPlan, TrackState
from jaxslam.tracking.step import track_step

_EDGE_PX = 2
"""Distance from the edge of what moves within which a pixel has no true label: flow and depth are of either side."""


class SeenPoints(NamedTuple):
    """Points as a cue saw them, `n` of them, in `CueResult.extra`.

    Attributes:
        features: Inputs of the network.
        uv: `(2, n)` positions of the points, pixels of the camera without distortion.
        region_of: `(n,)` region of each point; -1 for none.
    """

    features: LearnedFeatures
    uv: Pixels
    region_of: Int[Array, " n"]


class PointSamples(NamedTuple):
    """Samples of `t` frames with `n` points and `k` regions, in NumPy or JAX.

    Attributes:
        points: `(t, f, n)` features of the points.
        regions: `(t, c, k)` features of the regions.
        region_of: `(t, n)` region of each point; -1 for none.
        mask: `(t, n)` which points the cue classifies.
        moving: `(t, n)` which points are on something that moves.
        sure: `(t, n)` which of the classified points have a true label.
    """

    points: Any
    regions: Any
    region_of: Any
    mask: Any
    moving: Any
    sure: Any


@dataclass(frozen=True)
class TrackedScene:
    """A scene as it was tracked.

    Attributes:
        scene: The scene.
        samples: What the network saw, with labels.
        uv: `(t, 2, n)` positions of the points, pixels.
        weight: `(t, n)` weights that the cue, with its memory of regions, gave the points.
        T_world_cam: `(t, 7)` poses, `wxyz_xyz`.
        status: `(t,)` a `TrackStatus` of each frame.
        states: State before the frames 0, `window`, 2 `window` and so on.
    """

    scene: LabeledScene
    samples: PointSamples
    uv: Float[np.ndarray, "t 2 n"]
    weight: Float[np.ndarray, "t n"]
    T_world_cam: Float[np.ndarray, "t 7"]
    status: Int[np.ndarray, " t"]
    states: Sequence[TrackState]


@lru_cache  # the same function for the same cue: a new function would be compiled again
def recording(cue: Cue) -> Cue:
    """Return a cue with the same verdicts that puts what it saw into `CueResult.extra`, as `SeenPoints`."""

    def recorded(scene: CueInput, params: Any) -> CueResult:
        assert scene.regions is not None
        return cue(scene, params)._replace(extra=SeenPoints(learned_features(scene), scene.uv, scene.regions.of_point))

    return recorded


def tracker_with(
    camera: Camera, network: Any = None, *, temperature: float = 0.0, overrides: Sequence[str] = ()
) -> tuple[TrackPlan, TrackParams]:
    """Return the tracker with its default settings, whose only cue is recorded.

    Args:
        camera: Camera of the frames.
        network: A `PointNetwork` for the learned cue; `None` for the cue `clusters`.
        temperature: Softness of the verdicts.
        overrides: Settings that differ, as `load_config` takes them.
    """
    chosen = "clusters" if network is None else "learned"
    config = load_config(overrides=[*overrides, f"dynamics.cues=[{chosen}]", f"dynamics.temperature={temperature}"])
    plan, params = with_cues(track_plan(config.track), config.dynamics), track_params(camera, config.track)
    if network is None:
        return plan._replace(cues=(recording(plan.cues[0]),)), with_cue_params(params, config.dynamics)
    network = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), network)
    learned = LearnedParams(network, jnp.asarray(temperature, jnp.float32))
    return plan._replace(cues=(recording(learned_cue),)), params._replace(cues=(learned,))


def track_scene(
    scene: LabeledScene, plan: TrackPlan, params: TrackParams, *, window: int = 12, seed: int = 0
) -> TrackedScene:
    """Track a scene, and label what the cue saw.

    Args:
        scene: The scene; its camera has no distortion.
        plan: Plan of `tracker_with`.
        params: Parameters of `tracker_with`.
        window: Number of frames that are tracked in one call.
        seed: Seed of the tracker.
    """
    num, height, width = scene.moving.shape
    # A trained network is a result of a program, a new one is not: the tracker would be compiled for each.
    state, params = committed((init_state(height, width, plan, seed=seed), params))
    states, found = [], []
    for start in range(0, num, window):
        states.append(jax.device_get(state))
        state, outputs = _track_part(state, scene.part(start, start + window), params, plan=plan)
        found.append(jax.tree.map(lambda array, left=num - start: np.asarray(array)[:left], outputs))
    seen, weight, poses, status = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    moving, near_edge = true_labels(scene.moving, seen.uv)
    features = seen.features
    samples = PointSamples(
        features.points, features.regions, seen.region_of, features.mask, moving, features.mask & ~near_edge
    )
    return TrackedScene(scene, samples, seen.uv, weight, poses, status, states)


@compiled(when="first use", static="plan", options=FAST_COMPILE)
def _track_part(
    state: TrackState, clip: FrameArrays, params: TrackParams, *, plan: TrackPlan
) -> tuple[TrackState, tuple[SeenPoints, Array, Array, Array]]:
    def step(state: TrackState, frame: FrameArrays) -> tuple[TrackState, tuple[SeenPoints, Array, Array, Array]]:
        state, output = track_step(state, frame, params, plan)
        seen = output.cue_results[0].extra
        return state, (seen, verdicts(state, output), output.T_world_cam.wxyz_xyz, output.status)

    return lax.scan(step, state, clip)


def verdicts(state: TrackState, output: TrackOutput) -> Float[Array, " n"]:
    """Return the `(n,)` weights that the only cue of a plan gave the points, 0 in regions that moved a moment ago.

    Args:
        state: State after the frame.
        output: Output of the frame.
    """
    weight = output.cue_results[0].weight
    if output.regions is None:
        return weight
    kept = (state.regions.weight >= 0.5).astype(weight.dtype)
    return weight * of_points(kept, output.regions, jnp.ones((), weight.dtype))


def true_labels(
    moving: Bool[np.ndarray, "t h w"], uv: Float[np.ndarray, "t 2 n"]
) -> tuple[Bool[np.ndarray, "t n"], Bool[np.ndarray, "t n"]]:
    """Return `(t, n)` which points are on something that moves, and which are too near its edge to tell."""
    _, height, width = moving.shape
    frame = np.arange(len(moving))[:, None]
    column, row = np.moveaxis(np.round(np.nan_to_num(uv)).astype(int), 1, 0)
    column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
    return moving[frame, row, column], edges(moving)[frame, row, column]


def edges(moving: Bool[np.ndarray, "t h w"]) -> Bool[np.ndarray, "t h w"]:
    """Return `(t, h, w)` the pixels near the edge of what moves, which have no true label."""
    square = np.ones((2 * _EDGE_PX + 1,) * 2, np.uint8)
    images = moving.astype(np.uint8)
    return np.stack([cv2.dilate(image, square) != cv2.erode(image, square) for image in images])


class WrongPoints(NamedTuple):
    """Numbers of wrong verdicts.

    Attributes:
        moving_kept: Number of moving points that keep at least half of their weight.
        static_rejected: Number of static points that lose more than half of it.
        moving: Number of moving points.
        static: Number of static points.
    """

    moving_kept: int
    static_rejected: int
    moving: int
    static: int

    @property
    def share(self) -> float:
        """Share of the points whose verdict is wrong; 0 without any point."""
        return (self.moving_kept + self.static_rejected) / max(self.moving + self.static, 1)

    def __add__(self, other: Any) -> "WrongPoints":  # pyright: ignore[reportIncompatibleMethodOverride]
        return WrongPoints(*(one + two for one, two in zip(self, other, strict=True)))


def wrong_points(tracked: TrackedScene) -> WrongPoints:
    """Count the wrong verdicts of a cue on a scene."""
    samples, rejected = tracked.samples, tracked.weight < 0.5
    moving, static = samples.sure & samples.moving, samples.sure & ~samples.moving
    counts = (moving & ~rejected, static & rejected, moving, static)
    return WrongPoints(*(int(np.count_nonzero(each)) for each in counts))


def ate_of(tracked: TrackedScene) -> float:
    """Return the absolute trajectory error of a tracked scene (RMSE after SE(3) alignment), meters."""
    estimated, truth = (
        SE3(jnp.asarray(T_world_cam, jnp.float32)) for T_world_cam in (tracked.T_world_cam, tracked.scene.T_world_cam)
    )
    return float(jnp.sqrt(ate_loss(estimated, truth)))
