"""Cases for the cost of dynamic cues, compared with the optical flow of a frame by OpenCV."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.camera import back_project

from jaxslam.benchmark.kernels.case import Case, Problem
from jaxslam.benchmark.kernels.image_cases import moving_corners
from jaxslam.benchmark.kernels.scenes.room_views import (
    RoomViews,
    back_projected,
    followed_points,
    in_picture,
    projected,
    room_views,
)
from jaxslam.benchmark.reference_flow import NUM_CORNERS, opencv_flow
from jaxslam.config.cue_sections import OcclusionConfig
from jaxslam.config.schema import DynamicsConfig, TrackConfig
from jaxslam.dynamics.cue import CueInput, combine_cues
from jaxslam.dynamics.occlusion import PointState
from jaxslam.dynamics.regions import RegionMemory, RegionPlan, find_regions, moving_pixels, no_regions
from jaxslam.features.orb import DESCRIPTOR_BYTES, Features
from jaxslam.geometry.se3 import between, to_local, transform
from jaxslam.map.edit import with_keyframe, with_observations, with_points
from jaxslam.map.point_records import NONE, MapPoints, Observations
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.mapping.occlusion_states import PointStates
from jaxslam.sensors.frame_arrays import FrameMemory
from jaxslam.sensors.sensor_model import sensor_model
from jaxslam.tracking.cue_registry import with_cue_params, with_cues
from jaxslam.tracking.from_config import track_params
from jaxslam.tracking.state import TrackPlan

_SETTLING_STEPS = 20


def _flow() -> Callable[[], np.ndarray]:
    """OpenCV's optical flow of a frame, the unit in which the time of a cue is given."""
    previous, current, points = moving_corners(NUM_CORNERS)
    rows = np.ascontiguousarray(points.T)
    return lambda: opencv_flow(previous, current, rows)


def _wrong(weight: Any, moves: np.ndarray) -> float:
    """Share of points that rather move by their weights and do not, or the other way round."""
    return float(np.mean((np.asarray(weight) < 0.5) != moves))


def _chosen(views: RoomViews, config: DynamicsConfig) -> tuple[TrackPlan, tuple[Any, ...]]:
    """Cues as settings make them, and their parameters."""
    params = track_params(views.camera, TrackConfig())
    return with_cues(TrackPlan(), config), with_cue_params(params, config).cues


def _clusters(num_points: int) -> Problem:
    views = room_views()
    scene, moves = followed_points(views, num_points)
    plan, params = _chosen(views, DynamicsConfig(cues=("clusters",)))
    regions_plan = plan.regions or RegionPlan()
    depth, height, width = jnp.asarray(views.now.depth_m), views.camera.height, views.camera.width

    def ours(scene: CueInput, depth: Any, before: RegionMemory, params: tuple[Any, ...]) -> Any:
        X_cam = back_project(scene.intrinsics, scene.uv, scene.depth)
        regions = find_regions(scene.key, depth, before.centers, X_cam, scene.intrinsics, regions_plan)
        verdict = plan.cues[0](scene._replace(regions=regions), params[0])
        weight = before.weight if verdict.regions is None else verdict.regions.weight
        return verdict.weight, moving_pixels(regions, weight, height, width, regions_plan)

    return Problem(
        ours,
        (scene, depth, _settled(views, scene, regions_plan), params),
        _flow(),
        lambda ours, _: _wrong(ours[0], moves),
    )


def _settled(views: RoomViews, scene: CueInput, plan: RegionPlan) -> RegionMemory:
    """The regions of the frame before, as of a tracker that has seen many."""
    many = plan._replace(num_steps=_SETTLING_STEPS)
    depth, nowhere = jnp.asarray(views.before.depth_m), jnp.zeros((3, 0), jnp.float32)
    start = no_regions(plan, jnp.dtype(jnp.float32))
    found = find_regions(scene.key, depth, start.centers, nowhere, scene.intrinsics, many)
    return start._replace(centers=found.centers)


def _epipolar_trajectory(num_points: int) -> Problem:
    views = room_views()
    scene, moves = followed_points(views, num_points)
    plan, params = _chosen(views, DynamicsConfig(cues=("epipolar", "trajectory")))

    def ours(scene: CueInput, params: tuple[Any, ...]) -> Any:
        return combine_cues([cue(scene, its) for cue, its in zip(plan.cues, params, strict=True)], scene.weight)

    return Problem(ours, (scene, params), _flow(), lambda ours, _: _wrong(ours, moves))


def _occlusion(num_points: int) -> Problem:
    """Somebody stood before some of the points, and has gone."""
    views = room_views()
    X_world = _of_empty_room(views, num_points)
    under = _under(views, X_world)
    slam_map = _keyframe_map(views, X_world, np.where(under, PointState.BLOCKED, PointState.STATIC).astype(np.int8))
    states = PointStates(OcclusionConfig(enabled=True), sensor_model(views.camera, TrackConfig()), slam_map, num_points)
    arrays = FrameMemory(views.camera.height, views.camera.width).hold(views.empty.measured, 1 / 30)
    T_keyframe_cam = between(slam_map.pose(0), views.empty.T_world_cam)
    still = np.zeros(6, np.float32)
    share = float(np.mean(under))

    return Problem(
        lambda: np.float64(states.see(slam_map, 0, T_keyframe_cam, still, arrays)),
        (),
        _flow(),
        lambda ours, _: abs(float(ours) - share),
        compile=lambda: states.compile(arrays),
    )


def _of_empty_room(views: RoomViews, num_points: int) -> np.ndarray:
    """`(3, num_points)` points of the room all over the second picture, in the world."""
    depth = views.empty.exact_depth_m
    measured = np.flatnonzero(views.empty.depth_m)
    v, u = np.unravel_index(np.random.default_rng(1).choice(measured, num_points, replace=False), depth.shape)
    return transform(views.empty.T_world_cam, back_projected(views.camera, np.stack([u, v]), depth[v, u]))


def _under(views: RoomViews, X_world: np.ndarray) -> np.ndarray:
    """Tell which points the person hides in the second image."""
    uv, _ = projected(views.camera, to_local(views.now.T_world_cam, X_world))
    inside, (column, row) = in_picture(views.camera, uv)
    return inside & (views.now.instance_mask[row, column] > 0)


def _keyframe_map(views: RoomViews, X_world: np.ndarray, states: np.ndarray) -> Map:
    """Points in given states that one keyframe saw, where the camera was in the first frame."""
    pose, num = views.before.T_world_cam, X_world.shape[1]
    uv, depth = (array.astype(np.float32) for array in projected(views.camera, to_local(pose, X_world)))
    ids, whole = np.arange(num), np.ones(num, np.float32)
    keyframe = Keyframe(0, views.before.timestamp_ns, _no_features(), b"")
    no_descriptor = np.zeros((num, DESCRIPTOR_BYTES), np.uint8)
    points = MapPoints(ids, X_world, whole, no_descriptor, np.zeros(num, bool), np.zeros(num, np.int64), states)
    by_flow = np.full(num, NONE, np.int32)
    seen = Observations(np.zeros(num, np.int64), ids, by_flow, uv, uv, depth, whole, whole)
    slam_map = with_points(with_keyframe(empty_map(views.camera), keyframe, pose, NONE, 0), points)
    return with_observations(slam_map, seen)


def _no_features() -> Features:
    nowhere, none = np.zeros((2, 0), np.float32), np.zeros(0, np.float32)
    no_descriptor = np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
    return Features(nowhere, nowhere, none, np.zeros(0, np.uint8), none, no_descriptor)


_REFERENCE = f"cv2.calcOpticalFlowPyrLK of {NUM_CORNERS} corners"
_RATIO = (
    "not the same work: the ratio is what the cue adds to a frame, beside the optical flow of 640x480 pixels, pyramids"
    " included"
)
_WRONG = "share of the points that are taken to move and do not, or the other way round, with a person who walks"

CUE_CASES = (
    Case(
        name="cue_clusters",
        axis="points",
        sizes=(128, 512, 2048),
        reference=_REFERENCE,
        compared=f"regions of a depth image of 640x480 by K-means from those of the frame before, the cue, and the"
        f" pixels that move; {_RATIO}",
        difference=_WRONG,
        limit=0.1,
        problem=_clusters,
    ),
    Case(
        name="cue_epipolar_trajectory",
        axis="points",
        sizes=(128, 512, 2048),
        reference=_REFERENCE,
        compared=f"both cues, a fundamental matrix by RANSAC included; {_RATIO}",
        difference=_WRONG,
        limit=0.1,
        problem=_epipolar_trajectory,
    ),
    Case(
        name="cue_occlusion",
        axis="points",
        sizes=(500, 1000, 2000, 4000),
        reference=_REFERENCE,
        compared=f"states of the points of a keyframe after a frame of 640x480, with the guard, and room for 512 more"
        f" points; {_RATIO}",
        difference="share of the points that are OCCLUDED, and of those that a person stood before, their difference",
        limit=0.03,
        problem=_occlusion,
    ),
)
