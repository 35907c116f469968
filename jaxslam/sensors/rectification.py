"""Rectification of stereo pairs: the images of a `Rig` become those of one `Camera` with a baseline.

Source: Bouguet's method as in OpenCV's `stereoRectify`. The area that both images show fills the rectified ones.
"""

from pathlib import Path

import cv2
import numpy as np

from jaxslam.errors import CameraError, FrameError
from jaxslam.geometry.so3 import matrices, quaternions
from jaxslam.io.yaml_files import read_mapping
from jaxslam.sensors.camera import Camera, known_cameras
from jaxslam.sensors.camera_formats import is_pair
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.stereo_rig import Lens, Rig
from jaxslam.sensors.stereo_rig_formats import read_rig


class RectifiedPair:
    """Rectify the images of a rig; the pixel maps are computed once.

    Attributes:
        rig: The two cameras before rectification.
        camera: The camera of the rectified frames: no distortion, matching rows, and a baseline.
        T_left_camera: `(7,)` float64 wxyz_xyz pose of `camera` in the axes of the rig's left camera: a pure rotation.
    """

    def __init__(self, rig: Rig) -> None:
        """Compute the maps from rectified to raw pixels.

        Raises:
            CameraError: If the two views overlap too little to be rectified.
        """
        self.rig = rig
        (R_left, R_right), projection = _planes(rig)
        focal, (cx, cy) = float(projection[0, 0]), map(float, projection[:2, 2])
        baseline_m = float(np.linalg.norm(rig.T_left_right[4:]))
        far = None if rig.far_depth_baselines is None else rig.far_depth_baselines * baseline_m
        size = rig.left.width, rig.left.height
        try:
            self.camera = Camera(
                rig.name, *size, focal, focal, cx, cy, fps=rig.fps, baseline_m=baseline_m, far_depth_m=far
            )
        except CameraError as error:
            raise CameraError(f"rig '{rig.name}': the views share too little to be rectified: {error}") from None
        self.T_left_camera = np.concatenate([quaternions(R_left.T[None])[0], np.zeros(3)])
        self._maps = (_maps(rig.left, R_left, projection), _maps(rig.right, R_right, projection))

    @classmethod
    def load(cls, path: str | Path) -> "RectifiedPair":
        """Read the rig from a file of jaxslam, ORB-SLAM3 (`Camera1.*`, `Camera2.*`, `Stereo.T_c1_c2`) or Kalibr.

        Raises:
            CameraError: If there is no such file, or it is incomplete, misspelt or impossible.
        """
        return cls(read_rig(Path(path)))

    def images(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the two images rectified, of the same shape and type.

        Raises:
            FrameError: If an argument is not a uint8 image, or does not have the size of the rig's cameras.
        """
        for side, image in (("left", left), ("right", right)):
            _check(side, image, self.rig)
        of_left, of_right = self._maps
        return cv2.remap(left, *of_left, cv2.INTER_LINEAR), cv2.remap(right, *of_right, cv2.INTER_LINEAR)

    def of(self, timestamp_ns: int, left: np.ndarray, right: np.ndarray) -> Frame:
        """Return the rectified frame of two raw images taken at one time.

        Args:
            timestamp_ns: Time of exposure, int nanoseconds.
            left: `(height, width, 3)` RGB or `(height, width)` gray image of the left camera, uint8.
            right: Image of the right camera, of the same shape and type.

        Raises:
            FrameError: If an argument is not a uint8 image, does not have the size of the rig's cameras, or one image
                is in color and the other one gray.
        """
        image, other = self.images(left, right)
        return Frame(timestamp_ns, image, right=other)


def load_camera(source: str | Path) -> Camera | RectifiedPair:
    """Load a camera by its known name or from a file; a rectified pair if the file describes two cameras.

    Raises:
        CameraError: If there is no such name or file, or the file is incomplete, misspelled or impossible.
    """
    path = Path(source)
    if str(source) not in known_cameras() and path.is_file() and is_pair(read_mapping(path, CameraError)):
        return RectifiedPair.load(path)
    return Camera.load(source)


def _planes(rig: Rig) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return the rotations from each camera to the rectified one, and the `(3, 4)` projection that both share."""
    rotation, shift = np.array(rig.T_left_right[:4]), np.array(rig.T_left_right[4:])
    R_left_right = matrices(rotation / np.linalg.norm(rotation))
    # OpenCV takes the transform of the left camera's points to the right camera
    R, t = R_left_right.T, -(R_left_right.T @ shift)[:, None]
    cameras = (rig.left.matrix, rig.left.terms, rig.right.matrix, rig.right.terms)
    size = (rig.left.width, rig.left.height)
    if rig.left.model == "equidistant":
        R_1, R_2, P_1, *_ = cv2.fisheye.stereoRectify(
            *cameras, size, R, t, cv2.CALIB_ZERO_DISPARITY, newImageSize=size, balance=0.0
        )
    else:
        R_1, R_2, P_1, *_ = cv2.stereoRectify(*cameras, size, R, t, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
    return (np.asarray(R_1), np.asarray(R_2)), np.asarray(P_1)


def _maps(lens: Lens, R: np.ndarray, projection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the raw position of each rectified pixel, in the fixed-point form of `cv2.remap`."""
    make = cv2.fisheye.initUndistortRectifyMap if lens.model == "equidistant" else cv2.initUndistortRectifyMap
    whole, parts = make(lens.matrix, lens.terms, R, projection[:, :3], (lens.width, lens.height), cv2.CV_16SC2)
    return np.asarray(whole), np.asarray(parts)


def _check(side: str, image: object, rig: Rig) -> None:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        what = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise FrameError(f"{side}: expected (height, width, 3) RGB or (height, width) gray, uint8, got {what}")
    expected = (rig.left.height, rig.left.width)
    if image.shape[:2] != expected:
        got = "x".join(map(str, image.shape[1::-1]))
        raise FrameError(f"{side}: expected the {expected[1]}x{expected[0]} pixels of rig '{rig.name}', got {got}")
