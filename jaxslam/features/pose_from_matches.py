"""Pose of an image from map points matched with its features, if enough matches agree."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import without_distortion
from jaxslam_kernels.pose.pose_refine import PoseRefinement, PoseStatus, refine_pose
from jaxslam_kernels.types import Pixels, Points, Weights
from jaxtyping import Float, Float32, Float64, Int, Int64

from jaxslam.features.orb import FeaturePlan, Features, no_features
from jaxslam.geometry.se3 import IDENTITY, to_local
from jaxslam.geometry.types import Pose
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.runtime.padding import padded
from jaxslam.sensors.measurement import depth_sigma
from jaxslam.sensors.sensor_model import SensorModel

_MIN_SHARE = 0.5
"""Minimum share of the matches that agree with the final pose."""
_CELL = 0.15
"""Side of such a cell in focal lengths, 9 degrees: 48 cells in an image of 640 x 480 pixels and focal length 525."""
_SIGMA_PX = 1.0
"""Standard deviation of each coordinate of a feature of octave 0."""
_MAX_STEPS = 100
"""Largest number of steps. With the few points that a crowd leaves, 25 do not always do."""
_CHI2_GATES = (9.21, 11.34)
"""99 % quantiles of chi squared with two degrees of freedom and, where depth was measured, with three."""


class Matches(NamedTuple):
    """Points matched with features of an image, padded with weight 0 to a fixed size.

    Attributes:
        X: `(3, n)` points in the axes in which the pose is wanted, in meters.
        depth_then: `(n,)` depth from which each point was measured, whose error counts too; 0 for a point known better.
        uv: `(2, n)` matched features, in pixels of the ideal camera.
        depth: `(n,)` depth measured at the features, in meters; 0 for none.
        sigma_px: `(n,)` standard deviation of each coordinate of the features, in pixels.
        weight: `(n,)` weight of each match; 0 to ignore it.
    """

    X: Points
    depth_then: Weights
    uv: Pixels
    depth: Weights
    sigma_px: Weights
    weight: Weights


class PoseGates(NamedTuple):
    """Thresholds that a pose must meet to be believed.

    Attributes:
        min_inliers: Minimum number of matches that agree with it.
        min_cells: Minimum number of image cells that these cover.
        max_sigma: Largest standard deviation of the position in any direction, as a share of the median depth of the
            matches that agree.
    """

    min_inliers: int
    min_cells: int
    max_sigma: float


PLACE_GATES = PoseGates(min_inliers=30, min_cells=12, max_sigma=0.0075)
"""Those of a place that may be anywhere. With 8 cells, one of 900 pairs of images of one room came out 0.5 m wrong: a
small part of the image may show an object that exists twice. The deviation is 3 cm where points are 4 m away."""


class FeaturePose(NamedTuple):
    """Pose that enough matches agree with.

    Attributes:
        T_origin_cam: `wxyz_xyz` pose of the camera in the axes of the points.
        covariance: Covariance of the pose in the tangent space at the camera: translation (m), then rotation (rad). It
            does not include errors that the features have in common.
        agree: Indices of the inlier matches.
        share: Share of the matches that are inliers.
        num_cells: Number of image cells that the inliers cover.
        sigma: Largest standard deviation of the position in any direction, as a share of the median depth of the
            inliers.
    """

    T_origin_cam: Pose
    covariance: Float64[np.ndarray, "6 6"]
    agree: Int64[np.ndarray, " k"]
    share: float
    num_cells: int
    sigma: float

    def meets(self, gates: PoseGates) -> bool:
        """Tell whether the pose can be believed."""
        enough = len(self.agree) >= gates.min_inliers and self.num_cells >= gates.min_cells
        return enough and self.share >= _MIN_SHARE and self.sigma <= gates.max_sigma


def matches_of(
    X: Float[np.ndarray, "3 k"],
    depth_then: Float[np.ndarray, " k"],
    features: Features,
    which: Int[np.ndarray, " k"],
    plan: FeaturePlan,
    *,
    weight: Float[np.ndarray, " k"] | None = None,
    capacity: int | None = None,
) -> Matches:
    """Collect points matched with features as padded `Matches`.

    Args:
        X: `(3, k)` points, as in `Matches`.
        depth_then: `(k,)` depths, as in `Matches`.
        features: Features of the image.
        which: `(k,)` index of the feature matched with each point.
        plan: Settings of feature extraction.
        weight: `(k,)` weight of each match; 1 by default.
        capacity: Size to pad to; by default the maximum number of features.
    """
    capacity = plan.num_features if capacity is None else capacity
    columns = (
        X,
        depth_then,
        features.uv[:, which],
        features.depth[which],
        _SIGMA_PX * plan.scale(features.octave[which]),
        np.ones(len(which)) if weight is None else weight,
    )
    filled: Any = (padded(column.astype(np.float32), capacity, axis=-1) for column in columns)
    return Matches(*filled)


def fit_pose(
    T_origin_cam: Pose,
    matches: Matches,
    sensor: SensorModel,
    gates: PoseGates = PLACE_GATES,
) -> FeaturePose | None:
    """Fit a pose to matches; `None` if too few agree, cover too small a part of the image, or leave it too uncertain.

    Args:
        T_origin_cam: `(7,)` approximate pose to start from.
        matches: Points matched with features.
        sensor: Camera, of which ideal pixels leave the pinhole, and the error model of its depth.
        gates: What the pose must meet.
    """
    used = np.asarray(matches.weight) > 0
    num_used = int(np.count_nonzero(used))
    if num_used < gates.min_inliers:
        return None
    refined = _fitted(T_origin_cam, matches, sensor)
    gate = np.where(np.asarray(matches.depth) > 0, _CHI2_GATES[1], _CHI2_GATES[0])
    agree = np.flatnonzero(used & (np.asarray(refined.chi2) < gate))
    share = len(agree) / num_used
    if refined.status != PoseStatus.OK or not len(agree):
        return None
    pose = np.asarray(refined.T_world_cam.wxyz_xyz, np.float64)
    pose[:4] /= np.linalg.norm(pose[:4])
    # Residuals larger than expected make the pose less certain; smaller ones do not make it more certain.
    covariance = np.asarray(refined.covariance, np.float64) * max(float(refined.residual_scale), 1.0) ** 2
    covariance = 0.5 * (covariance + covariance.T)
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    depth_m = np.median(to_local(pose, np.asarray(matches.X, np.float64)[:, agree])[2])
    num_cells = _cells(np.asarray(matches.uv)[:, agree], sensor)
    found = FeaturePose(pose, covariance, agree, share, num_cells, float(sigma_m / depth_m))
    return found if found.meets(gates) else None


def compile_pose_fit(sensor: SensorModel, plan: FeaturePlan) -> None:
    """Compile what `fit_pose` needs for matches of the default capacity."""
    nothing = np.zeros(0, np.int64)
    _fitted(IDENTITY, matches_of(np.zeros((3, 0)), np.zeros(0), no_features(), nothing, plan), sensor)


def _fitted(T_origin_cam: Pose, matches: Matches, sensor: SensorModel) -> PoseRefinement:
    start: Any = T_origin_cam.astype(np.float32)
    return jax.device_get(_refined(SE3(start), matches, sensor))


def matches_depth_sigma(matches: Matches, sensor: SensorModel) -> Weights:
    """Compute the standard deviation of the difference between the earlier depth and the depth in the image."""
    return jnp.hypot(depth_sigma(matches.depth_then, sensor), depth_sigma(matches.depth, sensor))


def pinhole(sensor: SensorModel) -> tuple[Float64[np.ndarray, "2 1"], Float64[np.ndarray, "2 1"]]:
    """Return the focal lengths and the principal point, `(2, 1)` each."""
    fx, fy, cx, cy = (float(value) for value in sensor.intrinsics[:4])
    return np.array([[fx], [fy]]), np.array([[cx], [cy]])


def _cells(uv: Float32[np.ndarray, "2 n"], sensor: SensorModel) -> int:
    """Count the image cells that contain at least one of the pixels."""
    focal, center = pinhole(sensor)
    column, row = np.floor((uv - center) / (_CELL * focal)).astype(np.int64).tolist()
    return len(set(zip(column, row, strict=True)))  # a tenth of the time of `np.unique` with an axis


@compiled(when="warm-up", options=FAST_COMPILE)
def _refined(T_origin_cam: SE3, matches: Matches, sensor: SensorModel) -> PoseRefinement:
    return refine_pose(
        T_origin_cam,
        matches.X,
        matches.uv,
        without_distortion(sensor.intrinsics),
        weights=matches.weight,
        depth=matches.depth,
        sigma_px=matches.sigma_px,
        sigma_depth=matches_depth_sigma(matches, sensor),
        max_steps=_MAX_STEPS,
    )
