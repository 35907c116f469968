"""Find map points that are gone: the depth image of a frame shows another surface behind them.

Without it, the points of a chair that was moved between two visits would stay: no keyframe contradicts them, as each
observed them when the chair was there.

Source of the case: Ji, Wang and Xie, "Towards Real-time Semantic RGB-D SLAM in Dynamic Environments" (TRS-SLAM), 2021,
section III-B.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.types import DepthImage, Points, Scalar
from jaxtyping import Array, Bool, Float

from jaxslam.geometry.se3 import to_local
from jaxslam.geometry.types import Ids, Pose
from jaxslam.map.point_records import rows
from jaxslam.map.types import Map
from jaxslam.mapping.view_coverage import in_view
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.padding import padded
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import depth_sigma, expected_pixels, surface_depth
from jaxslam.sensors.sensor_model import SensorModel

_DEPTH_SIGMAS, _DEPTH_SHARE = 4.2, 0.05
"""Distance of a surface behind a point from which the point is gone: three standard deviations of the difference of two
measurements, and a share of the depth for errors of the pose and of the map."""
_BATCH = 4096
"""Number of points that are compared at once."""
_MAX_SHARE, _MIN_COMPARED = 0.15, 50
"""Share of the confirmed points that a frame may see through at its pose, of at least so many. At a right pose it is
below 0.005 in Bonn's `crowd` and 0.023 in the rendered flat; 0.3 m and 9 degrees beside it, 0.2 at the median."""
_MIN_VIEWS = 3
"""Number of keyframes that must observe a point for it to be confirmed."""


class FrameDepth:
    """The depth image of a frame, with which map points are compared.

    Attributes:
        twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        frame: The frame.
        sensor: Camera, and the error model of its depth.
    """

    def __init__(self, twist: Float[np.ndarray, "6"], frame: FrameArrays, sensor: SensorModel) -> None:
        """Keep a frame, whose arrays must not change."""
        self.twist, self.frame, self.sensor = twist.astype(np.float32), frame, sensor

    def compare(self, X_cam: Float[np.ndarray, "3 n"]) -> Bool[np.ndarray, "2 n"]:
        """Compare points, given in the camera frame in meters, with the depth.

        Returns:
            Masks of the points behind which the frame sees a surface, and of those that it sees where they are.
        """
        seen = np.zeros((2, X_cam.shape[1]), bool)
        of_frame = self.frame.ignore, self.frame.depth, self.frame.depth_delay_s, self.frame.readout_sign
        for start in range(0, X_cam.shape[1], _BATCH):
            some = X_cam[:, start : start + _BATCH].astype(np.float32)
            filled = padded(some, _BATCH, axis=-1)
            compared = _compared(filled, self.twist, *of_frame, self.sensor)
            seen[:, start : start + _BATCH] = np.asarray(compared)[:, : some.shape[1]]
        return seen

    def compile(self) -> None:
        """Compile what a frame of this size needs."""
        self.compare(np.zeros((3, 1)))


class VanishedPoints(NamedTuple):
    """Map points in view that a frame sees through.

    Attributes:
        ids: `(n,)` ids of the points behind which the frame sees another surface, in order.
        confirmed: `(n,)` whether at least three keyframes observe the point. Points on someone who walked by are gone
            from one keyframe to the next.
        there: `(m,)` ids of the points that it sees where they are, in order.
        num_shown: Number of confirmed points that are in view.
        num_there: Number of confirmed points that the frame sees where they are.
    """

    ids: Ids
    confirmed: Bool[np.ndarray, " n"]
    there: Ids
    num_shown: int
    num_there: int

    @property
    def contradict_pose(self) -> bool:
        """True if so many points are gone that the pose of the frame must be wrong."""
        num_gone = np.count_nonzero(self.confirmed)
        compared = num_gone + self.num_there
        return bool(compared >= _MIN_COMPARED and num_gone > _MAX_SHARE * compared)


def vanished_points(slam_map: Map, keyframe_ids: Ids, T_world_cam: Pose, seen: FrameDepth) -> VanishedPoints:
    """Find the map points that a frame sees through.

    Args:
        slam_map: The map.
        keyframe_ids: Ids of the keyframes around; only their points are looked at.
        T_world_cam: `(7,)` pose of the frame.
        seen: Depth of the frame.
    """
    near = slam_map.around(keyframe_ids)
    row = rows(near.points.ids, near.observations.point)
    views = np.bincount(row, minlength=len(near.points.ids))
    theirs = np.zeros(len(near.points.ids), bool)
    theirs[row[np.isin(near.observations.keyframe, keyframe_ids)]] = True
    shown = np.flatnonzero(theirs & in_view(near.camera, T_world_cam, near.points.X_world))
    confirmed = views[shown] >= _MIN_VIEWS
    gone, there = seen.compare(to_local(T_world_cam, near.points.X_world[:, shown]))
    ids = near.points.ids[shown]
    num_there = np.count_nonzero(confirmed & there)
    return VanishedPoints(ids[gone], confirmed[gone], ids[there], int(confirmed.sum()), int(num_there))


@compiled(when="warm-up")
def _compared(
    X_cam: Points,
    twist: Float[Array, "6"],
    ignore: Bool[Array, "h w"],
    depth: DepthImage,
    depth_delay_s: Scalar,
    readout_sign: Scalar | None,
    sensor: SensorModel,
) -> Bool[Array, "2 n"]:
    """Return masks of the points behind which the frame sees a surface, and of those that it sees where they are."""
    sensor = sensor.for_readout(readout_sign)
    pixels, expected = expected_pixels(X_cam, twist, ignore, sensor), X_cam[2]
    measured, known = surface_depth(expected, pixels.uv, twist, depth, depth_delay_s, sensor)
    known &= pixels.inside & ~pixels.ignored
    farther, tolerance = measured - expected, _DEPTH_SIGMAS * depth_sigma(measured, sensor) + _DEPTH_SHARE * expected
    return jnp.stack([known & (farther > tolerance), known & (jnp.abs(farther) <= tolerance)])
