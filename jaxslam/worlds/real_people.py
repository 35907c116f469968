"""People of a real recording, cut out and set by their depth into the pictures of a rendered world."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from jaxslam.datasets.protocol import frames_with_depth
from jaxslam.datasets.registry import open_dataset
from jaxslam.datasets.synthetic.virtual_camera import TakenPicture
from jaxslam.errors import ConfigError
from jaxslam.semantics import Detector, load_detector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.worlds.data_paths import data_path
from jaxslam.worlds.description import RealPeople
from jaxslam.worlds.person_mask import filled_depth, refined_mask

LABEL = "person"
"""Class label of all people of a recording, who share one number."""


class CutOut(NamedTuple):
    """People cut out of a frame, in the pixels of a world's camera.

    Attributes:
        rgb: `(height, width, 3)` uint8 color as recorded, of people and all else.
        depth_m: `(height, width)` float32 depth as recorded, of people and all else; 0 where missing.
        filled_m: `(height, width)` float32 depth of people, filled where missing: only to tell what is in front.
        mask: `(height, width)` bool, true on people.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]
    filled_m: Float32[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]


class PeopleCutter:
    """Cuts people out of a real recording at any time, as a world's camera would see them.

    People keep the place in the picture and the depth that they had for the camera of the recording. They have one
    number for all: where they cross, nothing tells reliably who is who.
    """

    def __init__(self, people: RealPeople, camera: Camera, seconds: float, scale: float = 1.0) -> None:
        """Open the recording and the network.

        Args:
            people: Description of the people, with paths that hold from here.
            camera: Camera of the world, without distortion.
            seconds: Length of the world's recording.
            scale: Factor of all depth.

        Raises:
            ConfigError: A variable in a path is not set, the recording is too short or has no depth, or the network
                gives no masks.
            DatasetError: The recording cannot be read.
            ModelError: The network cannot be read.
        """
        self._people, self._scale = people, np.float32(scale)
        self._recording = open_dataset(data_path(people.recording, Path()))
        network = data_path(people.network, Path())
        self._detector = load_detector(network, labels=(LABEL,))
        self._times_s = 1e-9 * (self._recording.timestamps_ns - self._recording.timestamps_ns[0])
        if self._times_s[-1] < people.from_s + seconds:
            needed = f"from_s + seconds, {people.from_s + seconds:g} s"
            raise ConfigError(f"RealPeople.recording: expected one of {needed}, got {self._times_s[-1]:.3f} s")
        if self._recording[0].depth_m is None:
            raise ConfigError(f"RealPeople.recording: expected one with depth, got '{people.recording}'")
        if _person_mask(self._detector, self._recording[0]) is None:
            raise ConfigError(f"RealPeople.network: expected one that gives masks, got boxes of '{network}'")
        self._map = _pixel_map(self._recording.camera, camera, people.mirrored)

    def cut_out(self, time_s: float) -> CutOut:
        """Cut people out of the frame of the recording, of those with depth, that is nearest in time.

        Args:
            time_s: Time since the start of the world's recording.

        Raises:
            DatasetError: The frame cannot be read.
            ModelError: The network fails.
        """
        frame = self._recording[self._nearest(self._people.from_s + time_s)]
        found = _person_mask(self._detector, frame)
        assert found is not None  # the network gives masks
        assert frame.depth_m is not None
        mask = refined_mask(found, frame.depth_m, frame.image)
        filled_m = filled_depth(mask, frame.depth_m)
        return CutOut(
            rgb=self._moved(frame.image, cv2.INTER_LINEAR),
            depth_m=self._scale * self._moved(frame.depth_m, cv2.INTER_NEAREST),
            filled_m=self._scale * self._moved(filled_m, cv2.INTER_NEAREST),
            mask=self._moved(mask.view(np.uint8), cv2.INTER_NEAREST).view(bool),
        )

    def _nearest(self, time_s: float) -> int:
        with_depth = np.flatnonzero(frames_with_depth(self._recording))
        return int(with_depth[np.argmin(np.abs(self._times_s[with_depth] - time_s))])

    def set_into(self, taken: TakenPicture, time_s: float, number: int) -> TakenPicture:
        """Set people into a picture where they are nearer than what is rendered.

        Their color and measured depth are those of the recording; as exact depth they have the measured one.

        Args:
            taken: A picture of the world.
            time_s: Its time since the start.
            number: Number of the people in masks.
        """
        cut, exact = self.cut_out(time_s), taken.exact
        shown = cut.mask & (cut.filled_m < exact.depth_m)
        return taken._replace(
            exact=exact._replace(
                depth_m=np.where(shown, cut.depth_m, exact.depth_m),
                owner=np.where(shown, np.int32(number), exact.owner),
            ),
            rgb=np.where(shown[..., None], cut.rgb, taken.rgb),
            depth_m=np.where(shown, cut.depth_m, taken.depth_m),
        )

    def _moved(self, image: np.ndarray, interpolation: int) -> np.ndarray:
        """Move an image to the pixels of the world's camera; 0 where the recording's camera does not see."""
        moved = cv2.remap(image, *self._map, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.ascontiguousarray(moved[:, ::-1]) if self._people.mirrored else moved


def _person_mask(detector: Detector, frame: Frame) -> Bool[np.ndarray, "h w"] | None:
    """Return the mask of all people in a frame; `None` from a network that gives boxes only."""
    found = detector(frame.image)
    if found.class_mask is not None:
        return found.class_mask
    return None if found.masks is None else np.asarray(found.masks.any(axis=0))


def _pixel_map(recorded: Camera, camera: Camera, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and rows in the recording's images of all pixels of a world's camera.

    A mirrored picture is one of the mirrored camera, mirrored.
    """
    cx = camera.width - 1 - camera.cx if mirrored else camera.cx
    inner, outer = (
        np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        for fx, fy, cx, cy in (
            (recorded.fx, recorded.fy, recorded.cx, recorded.cy),
            (camera.fx, camera.fy, cx, camera.cy),
        )
    )
    size = camera.width, camera.height
    columns, rows = cv2.initUndistortRectifyMap(
        inner, np.array(recorded.distortion), np.eye(3), outer, size, cv2.CV_32FC1
    )
    return np.asarray(columns), np.asarray(rows)
