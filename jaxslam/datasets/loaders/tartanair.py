"""Recordings in the layout of TartanAir (rendered): `image_left`, `image_right`, `depth_left` and `pose_left.txt`.

Source: Wang et al., "TartanAir: A Dataset to Push the Limits of Visual SLAM", IROS 2020. The camera is that of its
tools: 640x480, fx = fy = 320, cx = 320, cy = 240, 0.25 m between left and right. Frames have no timestamps: 10 frames
per second are assumed, which affects only the speeds of the motion model and errors per second.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxslam.datasets.image_folders import files_in
from jaxslam.datasets.paired_images import ImagePairs
from jaxslam.datasets.protocol import Fit, Loader
from jaxslam.errors import CameraError, DatasetError, TrajectoryError
from jaxslam.geometry.so3 import matrices, quaternions
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.image_files import read_color, read_depth_meters
from jaxslam.trajectory.trajectory import Trajectory

_LEFT, _RIGHT, _DEPTH, _POSES = "image_left", "image_right", "depth_left", "pose_left.txt"
_BASELINE_M, _RATE_HZ = 0.25, 10.0
_FARTHEST_M = 1000.0
"""Larger depth counts as missing: in the files the sky is about 10^4 m away."""
_CAMERA_FROM_NED = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""Rotation from axes x forward, y right, z down to x right, y down, z forward."""


class TartanAirDataset(ImagePairs):
    """A folder such as `P001`: frames with depth if there is `depth_left`, otherwise stereo pairs.

    For stereo pairs in a folder with depth, pass a camera with `baseline_m` and no `depth_scale_per_m`; the kind
    `tartanair_stereo` does so.

    Attributes:
        name: The folder's name.
        camera: The left camera.
        timestamps_ns: `(n,)` int64 nanoseconds from the start, at `fps` of the camera.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        """List the images; they are decoded on access.

        Raises:
            DatasetError: If images are missing, or the numbers of images differ.
        """
        self.name, self.camera, self._folder = folder.name, camera, folder
        first, other = folder / _LEFT, folder / (_RIGHT if camera.is_stereo else _DEPTH)
        for needed in (first, other):
            if not needed.is_dir():
                raise DatasetError(f"{needed}: expected a folder of images, got none")
        left, second = files_in(first, (".png",)), files_in(other, (".png",) if camera.is_stereo else (".npy",))
        if len(left) != len(second):
            raise DatasetError(f"{other}: expected as many files as in {_LEFT}, {len(left)}, got {len(second)}")
        self._files = list(zip(left, second, strict=True))
        self.timestamps_ns = np.round(np.arange(len(left)) * (1e9 / camera.fps)).astype(np.int64)

    def _truth(self) -> Trajectory | None:
        path = self._folder / _POSES
        return _read_poses(path, self.timestamps_ns) if path.is_file() else None

    @property
    def _readers(self) -> tuple[Callable[[Path], np.ndarray], Callable[[Path], np.ndarray]]:
        return read_color, read_color if self.camera.is_stereo else _read_depth


def _read_depth(path: Path) -> np.ndarray:
    depth_m = read_depth_meters(path)
    return np.where(depth_m <= _FARTHEST_M, depth_m, np.float32(0))


def _read_poses(path: Path, timestamps_ns: np.ndarray) -> Trajectory:
    """Read rows `tx ty tz qx qy qz qw` of a body with x forward, y right and z down, in a world with the same axes."""
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as problem:
        raise TrajectoryError(f"{path}: cannot be read: {problem}") from None
    if rows.shape != (len(timestamps_ns), 7):
        got = "x".join(map(str, rows.shape))
        raise TrajectoryError(
            f"{path}: expected tx ty tz qx qy qz qw of {len(timestamps_ns)} frames, got {got} numbers"
        )
    wxyz = rows[:, [6, 3, 4, 5]]
    if np.abs(np.linalg.norm(wxyz, axis=1) - 1).max() > 0.01:
        raise TrajectoryError(f"{path}: expected quaternions of unit length")
    R = _CAMERA_FROM_NED @ matrices(wxyz) @ _CAMERA_FROM_NED.T
    return Trajectory(timestamps_ns, np.hstack([quaternions(R), rows[:, :3] @ _CAMERA_FROM_NED.T]))


def _camera(folder: Path) -> Camera:
    has_depth, has_right = (folder / _DEPTH).is_dir(), (folder / _RIGHT).is_dir()
    if not has_depth and not has_right:
        raise CameraError(f"{folder}: expected {_DEPTH} or {_RIGHT}, got neither")
    return tartanair_camera(stereo=not has_depth)


def tartanair_camera(*, stereo: bool) -> Camera:
    """Return the camera of all recordings, with depth in meters or as a stereo pair."""
    lens = ("tartanair", 640, 480, 320.0, 320.0, 320.0, 240.0)
    if stereo:
        return Camera(*lens, fps=_RATE_HZ, baseline_m=_BASELINE_M)
    return Camera(*lens, fps=_RATE_HZ, depth_scale_per_m=1.0)


def _fit(folder: Path) -> Fit:
    return Fit.LAYOUT if (folder / _POSES).is_file() and (folder / _LEFT).is_dir() else Fit.NO


LOADER = Loader("tartanair", _fit, _camera, TartanAirDataset, files="pose_left.txt and image_left")
