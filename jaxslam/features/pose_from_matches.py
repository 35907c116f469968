"""The pose of an image from points found among its features, if enough of them agree on one."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import without_distortion
from jaxslam_kernels.pose.pose_refine import PoseRefinement, PoseStatus, refine_pose
from jaxslam_kernels.types import Pixels, Points, Weights
from jaxtyping import Float64, Int64

from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.runtime.compile_cache import FAST_COMPILE
from jaxslam.runtime.padding import padded
from jaxslam.runtime.trace_cache import cached_trace
from jaxslam.tracking.measurement import depth_sigma
from jaxslam.tracking.state import TrackParams

MIN_INLIERS = 30
"""Fewest features that agree in the end."""
MIN_SHARE = 0.5
"""Their least share of the features that were matched where the pose puts them."""
MIN_CELLS = 12
"""Fewest cells of the image they must lie in. With 8, one of 900 pairs of images of one room came out 0.5 m wrong:
what is seen in a small part of the image may be a thing that is there twice."""
_CELL = 0.15
"""Side of such a cell in focal lengths, 9 degrees: 48 of them in an image of 640 x 480 pixels and 525 focal length."""
MAX_SIGMA_M = 0.03
"""Largest standard deviation of the position in any direction, meters."""
_SIGMA_PX = 1.0
"""Standard deviation of a feature of octave 0, each coordinate."""
_CHI2_GATES = (9.21, 11.34)
"""99 % quantiles of chi squared with two degrees of freedom and, where depth was measured, three."""


class Matches(NamedTuple):
    """Points found among the features of an image; padded with weight 0 to a fixed size.

    Attributes:
        X: `(3, n)` where the points are, in the axes the pose is sought in, meters.
        depth_then: `(n,)` depth from which that was measured, whose error counts too; 0 for a point better known.
        uv: `(2, n)` the features, pixels of the ideal camera.
        depth: `(n,)` measured there, 0 for none.
        sigma_px: `(n,)` standard deviation of the features, each coordinate.
        weight: `(n,)` how much each counts, 0 for not at all.
    """

    X: Points
    depth_then: Weights
    uv: Pixels
    depth: Weights
    sigma_px: Weights
    weight: Weights


class FeaturePose(NamedTuple):
    """A pose that enough features agree on.

    Attributes:
        T_origin_cam: `wxyz_xyz`, in the axes of the points.
        covariance: Of it in the tangent space at the camera: translation (m), then rotation (rad). Errors that
            features have in common are not in it.
        agree: Index of each match that agrees.
        share: Their share of the matches.
    """

    T_origin_cam: Float64[np.ndarray, "7"]
    covariance: Float64[np.ndarray, "6 6"]
    agree: Int64[np.ndarray, " k"]
    share: float


def matches_of(
    X: np.ndarray,
    depth_then: np.ndarray,
    features: Features,
    which: np.ndarray,
    plan: FeaturePlan,
    *,
    weight: np.ndarray | None = None,
    capacity: int | None = None,
) -> Matches:
    """Points found among features, as `Matches`.

    Args:
        X: `(3, k)` as there.
        depth_then: `(k,)` as there.
        features: Of the image.
        which: `(k,)` index of the feature that each point was found at.
        plan: How features were found.
        weight: `(k,)` how much each counts; all alike by default.
        capacity: Size to pad to; the most features there can be by default.
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
    T_origin_cam: np.ndarray,
    matches: Matches,
    params: TrackParams,
    *,
    min_inliers: int | None = None,
    min_cells: int | None = None,
) -> FeaturePose | None:
    """The pose that most matches agree on; `None` where too few do, or in too small a part of the image.

    Args:
        T_origin_cam: `(7,)` a pose near it.
        matches: What was found.
        params: Camera, of which ideal pixels leave the pinhole, and the errors of its depth.
        min_inliers: Fewest matches that agree in the end, `MIN_INLIERS` by default,
        min_cells: and fewest cells of the image they lie in, `MIN_CELLS`.
    """
    min_inliers = MIN_INLIERS if min_inliers is None else min_inliers
    min_cells = MIN_CELLS if min_cells is None else min_cells
    refined: PoseRefinement = jax.device_get(_refined(SE3(jnp.asarray(T_origin_cam, jnp.float32)), matches, params))
    used = np.asarray(matches.weight) > 0
    gate = np.where(np.asarray(matches.depth) > 0, _CHI2_GATES[1], _CHI2_GATES[0])
    agree = np.flatnonzero(used & (np.asarray(refined.chi2) < gate))
    share = len(agree) / max(np.count_nonzero(used), 1)
    if refined.status != PoseStatus.OK or len(agree) < min_inliers or share < MIN_SHARE:
        return None
    pose = np.asarray(refined.T_world_cam.wxyz_xyz, np.float64)
    pose[:4] /= np.linalg.norm(pose[:4])
    # Residuals larger than expected make the pose less certain, smaller ones no more certain.
    covariance = np.asarray(refined.covariance, np.float64) * max(float(refined.residual_scale), 1.0) ** 2
    covariance = 0.5 * (covariance + covariance.T)
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    if _cells(np.asarray(matches.uv)[:, agree], params) < min_cells or sigma_m > MAX_SIGMA_M:
        return None
    return FeaturePose(pose, covariance, agree, share)


def matches_depth_sigma(matches: Matches, params: TrackParams) -> Weights:
    """Of the difference of depth measured then and in the image."""
    return jnp.hypot(depth_sigma(matches.depth_then, params), depth_sigma(matches.depth, params))


def pinhole(params: TrackParams) -> tuple[np.ndarray, np.ndarray]:
    """Focal length and principal point, `(2, 1)` each."""
    fx, fy, cx, cy = (float(value) for value in params.intrinsics[:4])
    return np.array([[fx], [fy]]), np.array([[cx], [cy]])


def _cells(uv: np.ndarray, params: TrackParams) -> int:
    """How many cells of the image hold one of the pixels."""
    focal, center = pinhole(params)
    return np.unique(np.floor((uv - center) / (_CELL * focal)), axis=1).shape[1]


@partial(jax.jit, compiler_options=FAST_COMPILE)
@cached_trace
def _refined(T_origin_cam: SE3, matches: Matches, params: TrackParams) -> PoseRefinement:
    return refine_pose(
        T_origin_cam,
        matches.X,
        matches.uv,
        without_distortion(params.intrinsics),
        weights=matches.weight,
        depth=matches.depth,
        sigma_px=matches.sigma_px,
        sigma_depth=matches_depth_sigma(matches, params),
    )
