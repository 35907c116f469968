"""Recordings in the layout of the TUM RGB-D benchmark: `rgb.txt`, `depth.txt` and optionally `groundtruth.txt`.

The two lists have other times and other lengths, and sensors skip images: of fr1/desk, 7 % of the color images have no
depth image at the same time. The `depth.txt` of every recording of Bonn also lists images that its archive lacks.

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

_MOST_MISSING = 0.1
"""Largest share of listed depth images that may be missing: Bonn's `kidnapping_box` lacks nine, a broken copy more."""

_COLOR_LIST, _DEPTH_LIST, _GROUND_TRUTH = "rgb.txt", "depth.txt", "groundtruth.txt"
LAYOUT = (_COLOR_LIST, _DEPTH_LIST)
"""Files that every recording of this layout has."""
_NAME = re.compile(r"rgbd_dataset_freiburg([123])_")


class TumDataset(ImagePairs):
    """A recording whose color and depth images are listed separately and matched by time, one to one.

    A frame has the timestamps of both its color and its depth image. Depth counts are converted to meters; the images
    are not changed otherwise. A color image between the first and the last frame with depth is a frame too if it has no
    depth image of its own.

    Attributes:
        name: The folder's name.
        camera: The camera that took the frames.
        timestamps_ns: `(n,)` int64 timestamps in nanoseconds, strictly increasing.
        has_depth: `(n,)` bool, true for frames that have a depth image.
        unmatched: Number of images left out because they have no partner within `MAX_GAP_S`.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        """Read the lists and match them; images are decoded on access.

        Raises:
            DatasetError: If a list is missing or malformed, a listed color image or more than a tenth of the listed
                depth images are missing, or nothing matches.
            CameraError: If the camera does not define the counts per meter.
        """
        if camera.depth_scale_per_m is None:
            raise CameraError(f"camera '{camera.name}': depth_scale_per_m: expected a number, got none")
        color, depth = read_file_list(folder / _COLOR_LIST), _without_missing(read_file_list(folder / _DEPTH_LIST))
        color_index, depth_index = _match(color, depth)
        first, last = color_index[[0, -1]].tolist()
        partner = np.full(len(color.files), -1)
        partner[color_index] = depth_index
        partner = partner[first : last + 1]
        self.name = folder.name
        self.camera = camera
        self.timestamps_ns = color.timestamps_ns[first : last + 1]
        self.has_depth = partner >= 0
        self._depth_timestamps_ns = depth.timestamps_ns[partner]  # those of frames without depth are not used
        self.unmatched = Unmatched(len(color.files) - len(partner), len(depth.files) - len(depth_index))
        self._folder = folder
        self._depth_scale_per_m = camera.depth_scale_per_m
        colors = color.files[first : last + 1]
        check_present(colors)
        depths = (None if index < 0 else depth.files[index] for index in partner)
        self._files = list(zip(colors, depths, strict=True))

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
    return all((folder / name).is_file() for name in LAYOUT)


def _without_missing(depth: FileList) -> FileList:
    """Return the images of a list that exist.

    Raises:
        DatasetError: If more than a tenth of them is missing.
    """
    present = np.array([file.is_file() for file in depth.files])
    if np.mean(~present) > _MOST_MISSING:
        check_present(depth.files)
    files = tuple(file for file, there in zip(depth.files, present, strict=True) if there)
    return FileList(depth.source, depth.timestamps_ns[present], files)


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


LOADER = Loader(
    "tum",
    _fit,
    _camera,
    TumDataset,
    files="rgb.txt and depth.txt",
    parts=LAYOUT,
    depth_scale_per_m=DEPTH_SCALE_PER_M,
)
