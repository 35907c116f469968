"""Recordings in the layout of the TUM RGB-D benchmark: `rgb.txt`, `depth.txt` and optionally `groundtruth.txt`.

Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012.
"""

import functools
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxslam.datasets.image_lists import FileList, read_file_list
from jaxslam.datasets.paired_images import ImagePairs, check_present
from jaxslam.datasets.protocol import Fit, Loader, Unmatched
from jaxslam.errors import CameraError, DatasetError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.image_files import read_color, read_depth
from jaxslam.trajectory.trajectory import Trajectory, associate, read_tum

MAX_GAP_S = 0.02
"""Largest gap in seconds between color and depth of a frame (as in the benchmark's own `associate.py`)."""

DEPTH_SCALE_PER_M = 5000.0
"""Counts of the depth images per meter, by the description of the benchmark."""

_COLOR_LIST, _DEPTH_LIST, _GROUND_TRUTH = "rgb.txt", "depth.txt", "groundtruth.txt"
_NAME = re.compile(r"rgbd_dataset_freiburg([123])_")


class TumDataset(ImagePairs):
    """A recording whose color and depth images are listed separately and matched by time, one to one.

    A frame has the timestamps of both its color and its depth image. Depth counts are converted to meters; the images
    are not changed otherwise.

    Attributes:
        name: The folder's name.
        camera: The camera that took the frames.
        timestamps_ns: `(n,)` int64 timestamps in nanoseconds, strictly increasing.
        unmatched: Number of images left out because they have no partner within `MAX_GAP_S`.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        """Read the lists and match them; images are decoded on access.

        Raises:
            DatasetError: If a list is missing or malformed, a listed image is missing, or nothing matches.
            CameraError: If the camera does not define the counts per meter.
        """
        if camera.depth_scale_per_m is None:
            raise CameraError(f"camera '{camera.name}': depth_scale_per_m: expected a number, got none")
        color, depth = read_file_list(folder / _COLOR_LIST), read_file_list(folder / _DEPTH_LIST)
        color_index, depth_index = _match(color, depth)
        matched = len(color_index)
        self.name = folder.name
        self.camera = camera
        self.timestamps_ns = color.timestamps_ns[color_index]
        self._depth_timestamps_ns = depth.timestamps_ns[depth_index]
        self.unmatched = Unmatched(len(color.files) - matched, len(depth.files) - matched)
        self._folder = folder
        self._depth_scale_per_m = camera.depth_scale_per_m
        self._files = [(color.files[i], depth.files[j]) for i, j in zip(color_index, depth_index, strict=True)]
        check_present(self._files)

    def _truth(self) -> Trajectory | None:
        path = self._folder / _GROUND_TRUTH
        return read_tum(path) if path.is_file() else None

    @property
    def _readers(self) -> tuple[Callable[[Path], np.ndarray], Callable[[Path], np.ndarray]]:
        return read_color, functools.partial(read_depth, scale_per_m=self._depth_scale_per_m)

    def _frame(self, index: int, first: np.ndarray, second: np.ndarray) -> Frame:
        depth_time = int(self._depth_timestamps_ns[index])
        return Frame(int(self.timestamps_ns[index]), first, second, depth_timestamp_ns=depth_time)


def has_layout(folder: Path) -> bool:
    """Whether a folder contains the two lists that every recording of this layout has."""
    return (folder / _COLOR_LIST).is_file() and (folder / _DEPTH_LIST).is_file()


def _match(color: FileList, depth: FileList) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the color and depth images that belong together, in the order of time."""
    pairs = associate(color.timestamps_ns, depth.timestamps_ns, MAX_GAP_S)
    if not len(pairs[0]):
        raise DatasetError(
            f"{color.source}: expected times within {MAX_GAP_S} s of those in {depth.source.name},"
            f" got {_span(color)} against {_span(depth)} (another clock or unit?)"
        )
    return pairs


def _span(images: FileList) -> str:
    first, last = images.timestamps_ns[[0, -1]] / 1e9
    return f"{first:.3f} to {last:.3f} s"


def _fit(folder: Path) -> Fit:
    if not has_layout(folder):
        return Fit.NO
    return Fit.NAME if _NAME.match(folder.name) else Fit.LAYOUT


def _camera(folder: Path) -> Camera | None:
    match = _NAME.match(folder.name)
    return Camera.load(f"tum_fr{match[1]}") if match else None


LOADER = Loader("tum", _fit, _camera, TumDataset, files="rgb.txt and depth.txt", depth_scale_per_m=DEPTH_SCALE_PER_M)
