"""The images of a folder in order, and their times from file names or a list."""

import re
from pathlib import Path

import numpy as np

from jaxslam.errors import DatasetError, TrajectoryError
from jaxslam.trajectory.formats import read_times

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
_NANOSECONDS = re.compile(r"\d{16,19}\Z")
_SECONDS = re.compile(r"\d+\.\d{1,9}\Z")


def files_in(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder with one of the suffixes, sorted by name; numbers are sorted by value.

    Raises:
        DatasetError: If there is no such file.
    """
    found = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    if not found:
        raise DatasetError(f"{folder}: expected files ending in {', '.join(suffixes)}, got none")
    return sorted(found, key=lambda path: (len(path.stem), path.stem) if path.stem.isdecimal() else (0, path.stem))


def times_of(files: list[Path], times: Path, fps: float) -> np.ndarray:
    """Return the `(n,)` int64 timestamps of images in nanoseconds, strictly increasing.

    Args:
        files: The images in order.
        times: A file of one timestamp in seconds per line, used if it exists. Otherwise names of 16 to 19 digits are
            read as nanoseconds, and decimal numbers as seconds.
        fps: Frames per second, used for names that are neither.

    Raises:
        DatasetError: If timestamps are malformed, do not increase, or do not match the number of images, or if only
            some of the names are timestamps.
    """
    if times.is_file():
        stamps, source = _read(times, len(files)), str(times)
    else:
        stems, source = [file.stem for file in files], str(files[0].parent)
        nano, seconds = (sum(bool(kind.match(stem)) for stem in stems) for kind in (_NANOSECONDS, _SECONDS))
        if nano + seconds > 0 and max(nano, seconds) < len(stems):
            odd = next(stem for stem in stems if not (_NANOSECONDS if nano >= seconds else _SECONDS).match(stem))
            raise DatasetError(f"{source}: expected every name to be a time as others are, got '{odd}'")
        if nano:
            stamps = np.array([int(stem) for stem in stems], np.int64)
        elif seconds:
            whole = [stem.split(".") for stem in stems]
            stamps = np.array([int(s) * 10**9 + int(part.ljust(9, "0")) for s, part in whole], np.int64)
        else:
            stamps = np.round(np.arange(len(files)) * (1e9 / fps)).astype(np.int64)
    late = np.flatnonzero(np.diff(stamps) <= 0)
    if late.size:
        raise DatasetError(f"{source}: expected times that increase, frame {late[0] + 1} does not")
    return stamps


def _read(path: Path, count: int) -> np.ndarray:
    try:
        stamps = read_times(path)
    except TrajectoryError as problem:
        raise DatasetError(str(problem)) from None
    if len(stamps) != count:
        raise DatasetError(f"{path}: expected one time an image, {count}, got {len(stamps)}")
    return stamps
