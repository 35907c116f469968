"""Pose of one camera beside OpenCV: RANSAC and refinement."""

from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.pose.pnp import ransac_pnp
from jaxslam_kernels.pose.pose_refine import refine_pose
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.case import Case, Problem
from jaxslam.benchmark.kernels.scenes.single_view import DISTORTION, MATRIX, PosedPoints, camera, make_scene

_THRESHOLD_PX = 3.0
_POINTS = 500
_FEW_GOOD = 0.65
"""Outliers where the number of hypotheses is varied: so many that OpenCV, too, tries as many as it may."""
_NEVER_SURE = 1 - 2**-53
"""The confidence at which OpenCV stops early, as near to one as it may be."""


def _ransac(num_points: int) -> Problem:
    scene = make_scene(0, num_points, outliers=0.5)
    return _ransac_problem(scene, 128, flags=cv2.SOLVEPNP_EPNP)


def _ransac_hypotheses(num_hypotheses: int) -> Problem:
    scene = make_scene(0, _POINTS, outliers=_FEW_GOOD)
    options = {"iterationsCount": num_hypotheses, "confidence": _NEVER_SURE, "flags": cv2.SOLVEPNP_AP3P}
    return _ransac_problem(scene, num_hypotheses, **options)


def _ransac_problem(scene: PosedPoints, num_hypotheses: int, **options: Any) -> Problem:
    X_world, uv, _, _ = scene.arrays(jnp.float32)
    X, pixels = scene.X_world.T.copy(), scene.uv.T.copy()

    def ours(key: Any, X_world: Any, uv: Any, intrinsics: Any) -> Any:
        return ransac_pnp(
            key, X_world, uv, intrinsics, threshold_px=_THRESHOLD_PX, num_hypotheses=num_hypotheses
        ).T_world_cam.wxyz_xyz

    def theirs() -> Any:
        return cv2.solvePnPRansac(X, pixels, MATRIX, DISTORTION, reprojectionError=_THRESHOLD_PX, **options)

    def difference(ours: Any, theirs: Any) -> float:
        found, rvec, tvec, _ = theirs
        return _distance_mm(ours, rvec, tvec) if found else np.inf

    return Problem(ours, (jax.random.key(0), X_world, uv, camera(jnp.float32)), theirs, difference)


def _refine_of(T: Any, X_world: Any, uv: Any, intrinsics: Any) -> Any:
    return refine_pose(T, X_world, uv, intrinsics, loss="squared").T_world_cam.wxyz_xyz


def _opencv_refine(scene: PosedPoints) -> Any:
    """A function that refines the pose of a scene, and gives rotation and translation vectors."""
    X, uv = scene.X_world.T.copy(), scene.uv.T.copy()
    rotation = Rotation.from_quat(np.roll(scene.initial[:4], -1)).inv()
    rvec, tvec = rotation.as_rotvec()[:, None], -rotation.apply(scene.initial[4:])[:, None]
    return lambda: cv2.solvePnPRefineLM(X, uv, MATRIX, DISTORTION, rvec.copy(), tvec.copy())


def _refine(num_points: int) -> Problem:
    scene = make_scene(0, num_points, outliers=0.0)
    X_world, uv, _, _ = scene.arrays(jnp.float32)
    start = SE3(jnp.asarray(scene.initial, jnp.float32))
    return Problem(
        _refine_of,
        (start, X_world, uv, camera(jnp.float32)),
        _opencv_refine(scene),
        lambda ours, theirs: _distance_mm(ours, *theirs),
    )


def _refine_batch(num_poses: int) -> Problem:
    scenes = [make_scene(seed, _POINTS, outliers=0.0) for seed in range(num_poses)]
    start, X_world, uv = (
        jnp.asarray(np.stack([getattr(scene, name) for scene in scenes]), jnp.float32)
        for name in ("initial", "X_world", "uv")
    )
    theirs = [_opencv_refine(scene) for scene in scenes]
    return Problem(
        jax.vmap(_refine_of, in_axes=(0, 0, 0, None)),
        (SE3(start), X_world, uv, camera(jnp.float32)),
        lambda: [refine() for refine in theirs],
        lambda ours, theirs: max(_distance_mm(a, *b) for a, b in zip(ours, theirs, strict=True)),
    )


def _distance_mm(wxyz_xyz: Any, rvec: np.ndarray, tvec: np.ndarray) -> float:
    """Between the position of a T_world_cam and that of OpenCV's T_cam_world."""
    position = -Rotation.from_rotvec(rvec[:, 0]).inv().apply(tvec[:, 0])
    return 1e3 * float(np.linalg.norm(np.asarray(wxyz_xyz)[4:] - position))


_SCENE = "points 1 to 5 m away, 1 px of noise"
_REFINED = (
    f"least squares from a start 5 cm and 3 degrees off until it has converged, {_SCENE}, lens distortion included"
)

POSE_CASES = (
    Case(
        name="ransac_pnp",
        axis="points",
        sizes=(60, 250, 1000, 4000),
        reference="cv2.solvePnPRansac",
        compared=f"{_SCENE}, half of them wrong, threshold 3 px; ours P3P with 128 hypotheses and refinement, OpenCV's"
        " EPnP with up to 100 and early stopping, its defaults",
        difference="distance of the positions, mm",
        limit=50.0,
        problem=_ransac,
    ),
    Case(
        name="ransac_pnp_hypotheses",
        axis="hypotheses",
        sizes=(64, 200, 640, 2000),
        reference="cv2.solvePnPRansac",
        compared=f"{_POINTS} {_SCENE}, {_FEW_GOOD:.0%} of them wrong, threshold 3 px; P3P on both sides, OpenCV with"
        " early stopping all but off",
        difference="distance of the positions, mm",
        limit=50.0,
        problem=_ransac_hypotheses,
    ),
    Case(
        name="pose_refine",
        axis="points",
        sizes=(60, 250, 1000, 4000),
        reference="cv2.solvePnPRefineLM",
        compared=_REFINED,
        difference="distance of the positions, mm",
        limit=0.1,
        problem=_refine,
    ),
    Case(
        name="pose_refine_batch",
        axis="poses",
        sizes=(1, 4, 16, 64),
        reference="cv2.solvePnPRefineLM in a loop",
        compared=f"vmap over poses of {_POINTS} points each: {_REFINED}",
        difference="largest distance of the positions, mm",
        limit=0.1,
        problem=_refine_batch,
    ),
)
