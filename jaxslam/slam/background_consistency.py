"""Whether what has no depth moves as the pose says: where only people are near enough to be measured, it does not.

Points without depth have no vote in the pose. With a sensor that reaches 2 m, in a room where two people walk by, all
points are on the people, they agree with each other, and the camera seems to walk. The background in the picture tells:
seen from a pose that moved by `t`, a corner at inverse depth `rho` moves along the epipolar line by `rho t`, and one
that does not would have to be very far away. Over a short way the background tells little, so that what the camera has
moved since it last had its say is unsure. It is sure again where the background has depth and points that the map had
before agree with the pose, or where the place is recognized.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.geometry.se3 import between, compose, rotate
from jaxslam.geometry.types import Pose
from jaxslam.mapping.track_table import TrackId
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.sensor_model import SensorModel
from jaxslam.slam.frame_result import FrameResult
from jaxslam.tracking.state import TrackOutput, TrackReason, TrackStatus

_MEASURED = 0.65
"""Share of the picture with depth from which on the background has its vote in the pose already. Recordings of sensors
that reach the walls have 0.7 to 0.9."""
_STEP = 8
"""Of the pixels that are looked at for it, one in so many, in rows and columns."""
_MARGIN_PX = 9
"""Corners keep so far from what has depth: its edge moves with it."""
_NUM_CORNERS, _FEWEST = 80, 12
_MAX_AGREE, _FEW_CONTRADICT = 0.5, 0.25
"""Shares of the corners that confirm a pose."""
_NEAREST, _FARTHEST = 0.1, 30.0
"""Times the median depth measured: what has no depth is expected between."""
_CLEAR_PX, _AGREE_PX, _APART_PX = 2.0, 2.0, 3.0
"""Motion along the epipolar line that tells a depth, and distance from that line of those that agree and of those that
do not; pixels."""
_SMALL = 0.03
"""Share of the median depth measured: a pose that is unsure by less is no weak one, with the covariance to say so."""
_MIN_MOVED = 0.2
"""Of the median depth, what the camera must have moved for the background to tell. Over less, a camera that circles
around the background sees it as one at rest does: with 0, wrong poses were confirmed in 7 of 12 rendered rooms."""
_MAX_FRAMES = 90
"""That corners are followed for before others are taken."""


class _KnownPoints(NamedTuple):
    """Points that were found before some frame.

    Attributes:
        next_track: Least id that the tracker gives to a point found later.
        next_point: Least id of a map point made later.
    """

    next_track: int
    next_point: int

    def count_agreeing(self, output: TrackOutput) -> int:
        """Return the least number of them that agree with the pose of a frame: as if all that disagree were of them."""
        matches = output.keyframe_matches
        ids = np.asarray(matches.id)[np.asarray(matches.weight) > 0].astype(np.int64)
        of_map = TrackId.is_map_point(ids)
        known = np.where(of_map, TrackId.map_points(ids) < self.next_point, ids < self.next_track)
        return int(known.sum()) - (len(ids) - int(output.num_keyframe_matches))


@dataclass(frozen=True)
class PoseDoubt:
    """Bound on the error of a translation.

    Attributes:
        unsure_m: Meters that the camera has moved, by its pose, without the background saying so.
        is_weak: Whether the background has said that it is not so, and it is more than a small part of the depth.
    """

    unsure_m: float = 0.0
    is_weak: bool = False


class BackgroundConsistency:
    """Follows corners without depth where too little of the picture has any, and compares their motion with the pose's.

    In rendered rooms with two people and depth up to 2 m or 1.6 m, poses are up to 1.8 m wrong; of 91 that are said to
    be `OK` (four camera paths, two seeds), none is wrong by more than 5 standard deviations, where all were.
    """

    def __init__(self, camera: Camera, sensor: SensorModel, min_inliers: float) -> None:
        """Begin with nothing to compare with.

        Args:
            camera: Camera that takes the frames.
            sensor: Camera with the limits of its depth.
            min_inliers: Number of points found before a doubt that must agree with a pose to end it: as many as make
                one.
        """
        self._K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        self._distortion = np.array(camera.distortion)
        self._min_inliers = min_inliers
        self._nearest_m, self._farthest_m = float(sensor.min_depth_m), float(sensor.max_depth_m)
        self.forget()

    def forget(self) -> None:
        """Begin anew: the pose is that of a place that was recognized, or the origin of a submap."""
        self._unsure_m = self._depth_m = 0.0
        self._known = _KnownPoints(0, 0)
        self._stop()

    def check(self, tracked: FrameResult, arrays: FrameArrays, output: TrackOutput, next_point: int) -> FrameResult:
        """Return the result with the covariance and the status that the background leaves it.

        Args:
            tracked: Result of a frame.
            arrays: The frame, with its mask.
            output: Output of the tracker for it.
            next_point: Id of the next point of the map.
        """
        if tracked.status == TrackStatus.LOST:
            return tracked
        if tracked.status in (TrackStatus.STARTED, TrackStatus.RELOCALIZED):
            self.forget()
        gray, depth, ignore = np.asarray(arrays.image), np.asarray(arrays.depth), np.asarray(arrays.ignore)
        doubt = self._compare(gray, depth, ignore, tracked, output)
        if not doubt.unsure_m:
            self._known = _KnownPoints(int(np.max(output.id)) + 1, next_point)
            return tracked
        covariance = tracked.covariance + np.diag(np.repeat(np.array([doubt.unsure_m**2, 0], np.float32), 3))
        if not doubt.is_weak or tracked.status != TrackStatus.OK:
            return replace(tracked, covariance=covariance)
        return replace(tracked, covariance=covariance, status=TrackStatus.WEAK, reason=TrackReason.UNCONFIRMED.text)

    def _compare(
        self, gray: np.ndarray, depth_m: np.ndarray, ignore: np.ndarray, tracked: FrameResult, output: TrackOutput
    ) -> PoseDoubt:
        """Compare a frame that was tracked with those before.

        Args:
            gray: `(h, w)` uint8; it is copied where it is needed.
            depth_m: `(h, w)` meters; 0 or not finite where nothing was measured.
            ignore: `(h, w)` true where nothing is to be trusted.
            tracked: Result of the frame.
            output: Output of the tracker for it.
        """
        T_world_cam = tracked.T_world_cam
        some = depth_m[::_STEP, ::_STEP]
        is_near = (some > self._nearest_m) & (some < self._farthest_m)
        num_near = np.count_nonzero(is_near)
        is_measured = num_near >= _MEASURED * some.size
        if is_measured or not num_near:
            self._stop()
            # For one, somebody who passes too near for the sensor is taken for the background: in a rendered flat,
            # 12,000 frames were weak after that, 10 mm off.
            if is_measured and self._unsure_m and self._known.count_agreeing(output) >= self._min_inliers:
                self._unsure_m = 0.0
            return self._doubt(0.0)
        self._depth_m = float(np.median(some[is_near]))
        without = self._without_depth(depth_m, ignore)
        if self._previous is None:
            self._begin(gray, without, T_world_cam)
            return self._doubt(0.0)
        self._T_world_first = compose(tracked.correction, self._T_world_first)
        self._follow(gray, without)
        T_first_cam = between(self._T_world_first, T_world_cam)
        moved_m = float(np.linalg.norm(T_first_cam[4:]))
        few = len(self._now) < _FEWEST
        if not few and moved_m < _MIN_MOVED * self._depth_m and self._frames < _MAX_FRAMES:
            return self._doubt(moved_m)
        if few or not self._confirms(T_first_cam):
            self._unsure_m += moved_m
        self._begin(gray, without, T_world_cam)
        return self._doubt(0.0)

    def _doubt(self, moved_m: float) -> PoseDoubt:
        """Add the motion since the background last confirmed a pose to the uncertainty."""
        return PoseDoubt(self._unsure_m + moved_m, self._unsure_m > _SMALL * self._depth_m)

    def _stop(self) -> None:
        self._previous: np.ndarray | None = None
        self._first = self._now = np.zeros((0, 2), np.float32)
        self._frames = 0

    def _begin(self, gray: np.ndarray, without: np.ndarray, T_world_cam: Pose) -> None:
        """Take corners of a frame to follow."""
        corners = cv2.goodFeaturesToTrack(gray, _NUM_CORNERS, 0.02, 12, mask=without)
        if corners is None or len(corners) < _FEWEST:
            self._stop()  # a background without texture tells nothing
            return
        self._first = self._now = corners[:, 0]
        self._previous, self._T_world_first, self._frames = gray.copy(), T_world_cam, 0

    def _follow(self, gray: np.ndarray, without: np.ndarray) -> None:
        """Follow the corners into a frame, as long as they have no depth there."""
        self._frames += 1
        if self._previous is not None and len(self._now):
            guess = np.zeros_like(self._now)
            now, found, _ = cv2.calcOpticalFlowPyrLK(
                self._previous, gray, self._now, guess, winSize=(15, 15), maxLevel=3
            )
            column, row = np.rint(now).astype(int).T
            inside = (column >= 0) & (row >= 0) & (column < gray.shape[1]) & (row < gray.shape[0])
            there = found[:, 0].astype(bool) & inside
            there[there] = without[row[there], column[there]] > 0
            self._first, self._now = self._first[there], now[there]
        self._previous = gray.copy()

    def _confirms(self, T_first_cam: Pose) -> bool:
        """Whether most corners move as the pose says, and visibly so, and few do not."""
        focal = (self._K[0, 0] + self._K[1, 1]) / 2
        first, now = (
            cv2.undistortPoints(corners[:, None], self._K, self._distortion)[:, 0].astype(np.float64)
            for corners in (self._first, self._now)
        )
        ray = rotate(np.tile(T_first_cam, (len(now), 1)), np.column_stack([now, np.ones(len(now))]))
        now = ray[:, :2] / ray[:, 2:]
        t = T_first_cam[4:]
        # A point at inverse depth rho is seen at (first - rho t_xy) / (1 - rho t_z).
        line, apart = t[:2] - now * t[2], first - now
        length = np.maximum(np.linalg.norm(line, axis=1), 1e-12)
        along = np.sum(apart * line, axis=1) / length
        across_px = focal * np.linalg.norm(apart - along[:, None] * line / length[:, None], axis=1)
        along_px, whole_px = focal * along, focal * length / self._depth_m  # the latter of a point at the median depth
        least_px, most_px = whole_px / _FARTHEST, whole_px / _NEAREST
        as_said = (across_px < _AGREE_PX) & (along_px > _CLEAR_PX) & (along_px < most_px + _APART_PX)
        as_said &= along_px > least_px - _AGREE_PX
        not_so = (across_px > _APART_PX) | (along_px < least_px - _AGREE_PX) | (along_px > most_px + _APART_PX)
        return bool(as_said.mean() > _MAX_AGREE and not_so.mean() < _FEW_CONTRADICT)

    def _without_depth(self, depth_m: np.ndarray, ignore: np.ndarray) -> np.ndarray:
        """`(h, w)` uint8, 255 where nothing was measured and nothing is masked, away from what is."""
        measured = ((depth_m > 0) & (depth_m < self._farthest_m)) | ignore
        side = 2 * _MARGIN_PX + 1
        around = cv2.dilate(measured.astype(np.uint8), np.ones((side, side), np.uint8))
        return np.where(around > 0, np.uint8(0), np.uint8(255))
