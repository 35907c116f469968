"""Residuals of tracked points for given parameters of the camera, and all derivatives.

A row of a rolling shutter, and a depth image of another time, are seen from where the camera is then: on the parabola
through the poses of the frame and of its neighbors.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import Intrinsics, project
from jaxslam_kernels.rolling_shutter import row_time
from jaxslam_kernels.se3 import cross_matrix, displacement, retract, to_camera
from jaxslam_kernels.types import Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float

from jaxslam.calibration.parameters import PARAMETERS, CameraVector
from jaxslam.calibration.track_block import TrackBlock
from jaxslam.errors import DatasetError
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE, SINGLE_THREAD

NUM_POSE, NUM_POINT = 18, 4
"""Numbers of tangents of the three poses that a frame depends on, and of a point with the error of its depth."""
NUM_TANGENTS = NUM_POSE + NUM_POINT + len(PARAMETERS)
_MIN_DEPTH_M = 1e-3


class _Frame(NamedTuple):
    """One frame, as traced.

    Attributes:
        poses: `(3, 7)` poses of the frame before, of this one, and of the frame after.
        motion: `(4,)` see `TrackBlock.motion_weights`.
        delay_s: Time from the image to the depth image.
        time_sign: 1, or -1 where the recording is played backward.
        uv: Pixels of the points.
        plane: Inverse depth around the points.
        plane_uv: Pixels around which that holds.
        plane_sigma: Its standard deviation.
    """

    poses: Float[Array, "3 7"]
    motion: Float[Array, "4"]
    delay_s: Scalar
    time_sign: Scalar
    uv: Pixels
    plane: Points
    plane_uv: Pixels
    plane_sigma: Weights


class Linearized(NamedTuple):
    """Residuals of a block with their derivatives.

    Attributes:
        residuals: `(f, 3, p)` of the pixel, in pixels, and of the inverse depth, in its standard deviations
            `DepthPlanes.sigma`.
        jacobian: `(f, 3, p, t)` derivatives by the tangents of the poses of the frame before, of the frame, and of the
            frame after, by the point, and by the parameters.
    """

    residuals: Float[np.ndarray, "f 3 p"]
    jacobian: Float[np.ndarray, "f 3 p t"]


def linearize(
    block: TrackBlock, poses: np.ndarray, points: np.ndarray, camera: CameraVector, *, height: int
) -> Linearized:
    """Compute the residuals of a block and their derivatives, in single precision.

    Args:
        block: The block.
        poses: `(f, 7)` poses of its frames.
        points: `(4, p)` positions of its points, meters, and the error that all measurements of the inverse depth of a
            point share, in standard deviations `DepthPlanes.sigma`: neighboring pixels and successive images have it in
            common.
        camera: Parameters of the camera.
        height: Rows of the image.

    Raises:
        DatasetError: If a derivative of a residual that is used is not finite.
    """
    arguments = _arguments(block, poses, points, camera)
    residuals, jacobian = _linearized(*arguments, height=height)
    # Out of the compiled function tangents come first, as that is how they are computed.
    linearized = Linearized(np.asarray(residuals, np.float64), np.moveaxis(np.asarray(jacobian, np.float64), 1, -1))
    _check_finite(linearized.jacobian, np.stack([block.seen, block.seen, block.measured], axis=1))
    return linearized


def _check_finite(jacobian: Float[np.ndarray, "f 3 p t"], used: Bool[np.ndarray, "f 3 p"]) -> None:
    wrong = used & ~np.isfinite(jacobian).all(axis=-1)
    if wrong.any():
        frames = np.flatnonzero(wrong.any(axis=(1, 2)))
        raise DatasetError(
            f"calibration: expected finite derivatives of {used.sum()} residuals of a block, got {wrong.sum()} that are"
            f" not, in its frames {', '.join(map(str, frames[:5]))}; another --focal-px to begin with may help"
        )


def residuals_of(
    block: TrackBlock, poses: np.ndarray, points: np.ndarray, camera: CameraVector, *, height: int
) -> tuple[Float[np.ndarray, "f 3 p"], Float[np.ndarray, "f 2 p"]]:
    """Compute the residuals of a block alone, and the pixels at which its depth images show the points.

    Args:
        block: The block.
        poses: See `linearize`.
        points: See `linearize`.
        camera: See `linearize`.
        height: See `linearize`.
    """
    residuals, depth_uv = _residuals(*_arguments(block, poses, points, camera), height=height)
    return np.asarray(residuals, np.float64), np.asarray(depth_uv, np.float64)


def _arguments(
    block: TrackBlock, poses: np.ndarray, points: np.ndarray, camera: CameraVector
) -> tuple[_Frame, np.ndarray, np.ndarray]:
    last = block.num_frames - 1
    around = np.clip(np.arange(block.num_frames)[:, None] + np.array([-1, 0, 1]), 0, last)
    frames = _Frame(
        poses=poses[around],  # pyright: ignore[reportArgumentType]
        motion=block.motion_weights(),  # pyright: ignore[reportArgumentType]
        delay_s=block.delay_s,  # pyright: ignore[reportArgumentType]
        time_sign=block.time_sign,  # pyright: ignore[reportArgumentType]
        uv=block.uv,  # pyright: ignore[reportArgumentType]
        plane=block.depth.plane,  # pyright: ignore[reportArgumentType]
        plane_uv=block.depth.uv,  # pyright: ignore[reportArgumentType]
        plane_sigma=block.depth.sigma,  # pyright: ignore[reportArgumentType]
    )
    single = jax.tree.map(lambda array: np.asarray(array, np.float32), (frames, points, camera))
    return single


@compiled(when="first use", static="height", options=FAST_COMPILE | SINGLE_THREAD)
def _linearized(
    frames: _Frame, points: Float[Array, "4 p"], camera: Array, *, height: int
) -> tuple[Float[Array, "f 3 p"], Float[Array, "f t 3 p"]]:
    def of_frame(frame: _Frame) -> tuple[Float[Array, "3 p"], Float[Array, "t 3 p"]]:
        def moved(tangents: Float[Array, " t"]) -> Float[Array, "3 p"]:
            return _of_frame(tangents, frame, points, camera, height)[0]

        # A tangent of a point moves all points of the frame: a residual depends on its own point alone.
        basis = jnp.eye(NUM_TANGENTS, dtype=points.dtype)
        value, derivative = jax.linearize(moved, jnp.zeros(NUM_TANGENTS, points.dtype))
        return value, jax.vmap(derivative)(basis)

    return jax.lax.map(of_frame, frames)


@compiled(when="first use", static="height", options=FAST_COMPILE | SINGLE_THREAD)
def _residuals(
    frames: _Frame, points: Float[Array, "4 p"], camera: Array, *, height: int
) -> tuple[Float[Array, "f 3 p"], Float[Array, "f 2 p"]]:
    still = jnp.zeros(NUM_TANGENTS, points.dtype)
    return jax.lax.map(lambda frame: _of_frame(still, frame, points, camera, height), frames)


def _of_frame(
    tangents: Float[Array, " t"],
    frame: _Frame,
    points: Float[Array, "4 p"],
    camera: Array,
    height: int,
) -> tuple[Float[Array, "3 p"], Pixels]:
    """Residuals of one frame, and where its depth image shows the points, with everything moved by tangents."""
    pose_tangents, point_tangent = tangents[:NUM_POSE], tangents[NUM_POSE : NUM_POSE + NUM_POINT]
    before, now, after = (retract(SE3(frame.poses[k]), pose_tangents[6 * k : 6 * k + 6]) for k in range(3))
    parameters = camera + tangents[NUM_POSE + NUM_POINT :]
    intrinsics = Intrinsics(*parameters[:4], distortion=parameters[4:9])
    offset_m, delay_s, readout_s = parameters[9:12]
    shared = points[3] + point_tangent[3]
    X_cam = to_camera(now, points[:3] + point_tangent[:3, None])
    motions = displacement(now, before), displacement(now, after)

    def motion_until(elapsed_s: Weights) -> Float[Array, "6 p"]:
        return _motion_until(elapsed_s, motions, frame.motion)

    rows_s = row_time(frame.uv[1], height, readout_s * frame.time_sign)
    pixels = project(intrinsics, _from_moved_camera(X_cam, motion_until(rows_s))) - frame.uv
    later = _from_moved_camera(X_cam, motion_until(jnp.full_like(rows_s, frame.delay_s + frame.time_sign * delay_s)))
    X_depth = _small_rotation(parameters[12:15]) @ (later + jnp.append(parameters[15:17], 0.0)[:, None])
    depth_uv = project(intrinsics, X_depth)
    shift = depth_uv - frame.plane_uv
    measured = frame.plane[0] + jnp.sum(frame.plane[1:] * shift, axis=0)
    expected = 1 / jnp.maximum(X_depth[2] + offset_m, _MIN_DEPTH_M)
    return jnp.concatenate([pixels, ((expected - measured) / frame.plane_sigma + shared)[None, :]]), depth_uv


_ROW_STEPS = 4
"""Steps that find the row at which a rolling shutter sees a point: each leaves a hundredth of the error."""


def predicted_pixels(
    block: TrackBlock, poses: np.ndarray, X_world: np.ndarray, camera: CameraVector, *, height: int
) -> Float[np.ndarray, "f 2 n"]:
    """Compute the pixels at which the color images of a block show points, wherever those were tracked.

    Args:
        block: The block.
        poses: See `linearize`.
        X_world: `(3, n)` positions of points, meters; of any number.
        camera: See `linearize`.
        height: See `linearize`.
    """
    frames, points, parameters = _arguments(block, poses, X_world, camera)
    return np.asarray(_predicted(frames.poses, frames.motion, frames.time_sign, points, parameters, height=height))


@compiled(when="first use", static="height", options=FAST_COMPILE | SINGLE_THREAD)
def _predicted(
    poses: Float[Array, "f 3 7"],
    motion: Float[Array, "f 4"],
    time_sign: Float[Array, " f"],
    X_world: Points,
    camera: Array,
    *,
    height: int,
) -> Float[Array, "f 2 n"]:
    intrinsics = Intrinsics(*camera[:4], distortion=camera[4:9])

    def of_frame(arguments: tuple[Array, Array, Array]) -> Pixels:
        poses, motion, time_sign = arguments
        before, now, after = (SE3(poses[k]) for k in range(3))
        X_cam = to_camera(now, X_world)
        motions = displacement(now, before), displacement(now, after)
        uv = project(intrinsics, X_cam)
        for _ in range(_ROW_STEPS):
            rows_s = row_time(uv[1], height, camera[11] * time_sign)
            uv = project(intrinsics, _from_moved_camera(X_cam, _motion_until(rows_s, motions, motion)))
        return uv

    return jax.lax.map(of_frame, (poses, motion, time_sign))


def _motion_until(
    elapsed_s: Weights, motions: tuple[Float[Array, "6"], Float[Array, "6"]], weights: Float[Array, "4"]
) -> Float[Array, "6 n"]:
    """Motion of the camera after times since the frame, `(6, n)`; see `TrackBlock.motion_weights`."""
    back = weights[0] * elapsed_s + weights[1] * jnp.square(elapsed_s)
    on = weights[2] * elapsed_s + weights[3] * jnp.square(elapsed_s)
    return motions[0][:, None] * back[None, :] + motions[1][:, None] * on[None, :]


def _small_rotation(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a rotation vector of a few hundredths of a radian, to second order."""
    turn = cross_matrix(w)
    return jnp.eye(3, dtype=w.dtype) + turn + 0.5 * turn @ turn


def _from_moved_camera(X_cam: Points, motion: Float[Array, "6 p"]) -> Points:
    """Points in the axes of cameras that have moved by `exp(motion)`, one motion a point, of less than a radian."""
    v, w = motion[:3], motion[3:]
    square = jnp.sum(jnp.square(w), axis=0)[None, :]
    # sin(a) / a, (1 - cos(a)) / a^2 and (a - sin(a)) / a^3 of the angle a, as series.
    first = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
    second = 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56))
    third = (1 - square / 20 * (1 - square / 42)) / 6

    def cross(a: Points, b: Points) -> Points:
        return jnp.cross(a, b, axis=0)

    turned = cross(w, v)
    apart = X_cam - (v + second * turned + third * cross(w, turned))
    across = cross(w, apart)
    return apart - first * across + second * cross(w, across)
