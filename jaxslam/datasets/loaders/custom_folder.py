"""Your own images in two folders, `left` and `right` or `rgb` and `depth`, with a camera file."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.datasets.image_folders import IMAGES, files_in, times_of
from jaxslam.datasets.loaders.tum import LAYOUT
from jaxslam.datasets.paired_images import ImagePairs, check_stereo, moved
from jaxslam.datasets.protocol import Fit, Loader
from jaxslam.errors import CameraError, DatasetError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.image_files import read_color, read_depth, read_depth_meters
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.trajectory.trajectory import Trajectory, read_tum

_COLOR, _DEPTH, _LEFT, _RIGHT = ("rgb", "color", "image"), "depth", "left", "right"
_TIMES, _GROUND_TRUTH = "times.txt", "groundtruth.txt"
_METERS = ".npy"


class _Layout(NamedTuple):
    """The two folders of images.

    Attributes:
        first: Folder of the color or left images.
        second: Folder of the depth or right images.
        pair: Whether they are stereo pairs.
    """

    first: Path
    second: Path
    pair: bool


class FolderDataset(ImagePairs):
    """Two folders of images, both sorted by name; the nth image of one belongs to the nth of the other.

    `left` and `right` hold stereo pairs; `rgb` (or `color`, `image`) and `depth` hold color and depth, as counts in
    .png (`depth_scale_per_m` of the camera) or as meters in .npy. Timestamps come from `times.txt` (seconds, one per
    line); without it from the file names, as nanoseconds (16 to 19 digits) or seconds (with decimals); otherwise frames
    are spaced by `fps` of the camera. `groundtruth.txt` may hold poses in the format of TUM.

    Attributes:
        name: The folder's name.
        camera: The camera, or the rectified camera of a stereo pair that is not rectified.
        timestamps_ns: `(n,)` int64 timestamps in nanoseconds, strictly increasing.
    """

    def __init__(self, folder: Path, camera: Camera | RectifiedPair) -> None:
        """List the images; they are decoded on access.

        Raises:
            DatasetError: If folders are missing or ambiguous, the numbers of images differ, or timestamps are
                malformed.
            CameraError: If the camera is not of the kind that the folders need.
        """
        layout = _layout(folder)
        self._taken_with(camera)
        self.name, self._folder = folder.name, folder
        first = files_in(layout.first, IMAGES)
        second = files_in(layout.second, IMAGES) if layout.pair else _depth_files(layout.second)
        _check_camera(self.camera, folder, layout, second[0].suffix)
        if len(first) != len(second):
            raise DatasetError(
                f"{layout.second}: expected as many images as in {layout.first.name}, {len(first)}, got {len(second)}"
            )
        self._files = list(zip(first, second, strict=True))
        self.timestamps_ns = times_of(first, folder / _TIMES, self.camera.fps)

    def _truth(self) -> Trajectory | None:
        """Return the poses of `groundtruth.txt`, which are those of the camera before rectification."""
        path = self._folder / _GROUND_TRUTH
        if not path.is_file():
            return None
        truth = read_tum(path)
        return truth if self._pair is None else moved(truth, self._pair.T_left_camera)

    @property
    def _readers(self) -> tuple[Callable[[Path], np.ndarray], Callable[[Path], np.ndarray]]:
        return read_color, read_color if self.camera.is_stereo else self._depth

    def _depth(self, path: Path) -> np.ndarray:
        if path.suffix == _METERS:
            return read_depth_meters(path)
        return read_depth(path, self.camera.depth_scale_per_m or 1.0)  # checked in __init__


def _layout(folder: Path) -> _Layout:
    color = [name for name in _COLOR if (folder / name).is_dir()]
    sides = [name for name in (_LEFT, _RIGHT) if (folder / name).is_dir()]
    depth = (folder / _DEPTH).is_dir()
    if len(sides) == 2 and not depth:
        return _Layout(folder / _LEFT, folder / _RIGHT, True)
    if len(color) == 1 and depth and not sides:
        return _Layout(folder / color[0], folder / _DEPTH, False)
    there = [*color, *sides, *([_DEPTH] if depth else [])]
    raise DatasetError(
        f"{folder}: expected the folders left and right, or depth and one of {', '.join(_COLOR)}, got"
        f" {' and '.join(there) or 'neither'}"
    )


def _depth_files(folder: Path) -> list[Path]:
    kinds = {path.suffix for path in folder.iterdir() if path.suffix in (".png", _METERS)}
    if len(kinds) > 1:
        raise DatasetError(f"{folder}: expected depth as .png or as .npy, got both")
    return files_in(folder, (".png", _METERS))


def _check_camera(camera: Camera, folder: Path, layout: _Layout, suffix: str) -> None:
    if layout.pair:
        check_stereo(camera)
        return
    if camera.is_stereo:
        raise CameraError(f"camera '{camera.name}': expected one with depth for {folder}, got a stereo pair")
    if suffix != _METERS and camera.depth_scale_per_m is None:
        raise CameraError(f"camera '{camera.name}': depth_scale_per_m: expected a number for depth as .png, got none")


def _fit(folder: Path) -> Fit:
    if any((folder / name).is_file() for name in LAYOUT):
        return Fit.NO  # a recording of TUM that lacks a list
    names = [name for name in (*_COLOR, _DEPTH, _LEFT, _RIGHT) if (folder / name).is_dir()]
    return Fit.FOLDERS if (_DEPTH in names or _LEFT in names) and len(names) > 1 else Fit.NO


def _camera(_: Path) -> None:
    return None


LOADER = Loader(
    "folder", _fit, _camera, FolderDataset, rectifies=True, files="folders left and right, or rgb and depth"
)
