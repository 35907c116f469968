"""Lists of images with timestamps, such as `rgb.txt`: one `timestamp file` per line, in seconds, `#` for comments."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxslam.errors import DatasetError
from jaxslam.io.timestamps import nanoseconds

_LONGEST_PAUSE_STEPS = 10**6  # nine hours at 30 frames per second; a longer pause is a change of unit


@dataclass(frozen=True)
class FileList:
    """Images in the order of time.

    Attributes:
        source: The file that the list was read from.
        timestamps_ns: `(n,)` int64 timestamps in nanoseconds, strictly increasing.
        files: The path of each image.
    """

    source: Path
    timestamps_ns: np.ndarray
    files: tuple[Path, ...]


def read_file_list(path: Path) -> FileList:
    """Read a list of images. The files it names are relative to its folder, and are not opened.

    Raises:
        DatasetError: If the list is missing, empty or unreadable, or a line is malformed, not in seconds or
            not later than the line before it. The message names the file and the line.
    """
    timestamps: list[int] = []
    lines: list[int] = []
    files: list[Path] = []
    for number, line in enumerate(_read_lines(path), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.replace(",", " ").split()
        if len(fields) != 2:
            raise DatasetError(f"{path}:{number}: expected `timestamp file`, got '{line.strip()}'")
        timestamps.append(nanoseconds(fields[0], f"{path}:{number}", DatasetError, least_s=0))
        files.append(path.parent / fields[1])
        lines.append(number)
    if not files:
        raise DatasetError(f"{path}: expected at least one line `timestamp file`, got none")
    stamps = np.array(timestamps, np.int64)
    _check_order(path, stamps, lines)
    return FileList(path, stamps, tuple(files))


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as problem:
        raise DatasetError(f"{path}: cannot be read: {problem.strerror}") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: expected text in UTF-8, got something else") from None


def _check_order(path: Path, stamps: np.ndarray, lines: list[int]) -> None:
    steps = np.diff(stamps)
    if (late := np.flatnonzero(steps <= 0)).size:
        first = int(late[0])
        what = "the same time again" if steps[first] == 0 else "an earlier time"
        raise DatasetError(
            f"{path}:{lines[first + 1]}: expected a time after the {stamps[first] / 1e9:.6f} s before it,"
            f" got {what}, {stamps[first + 1] / 1e9:.6f} s"
        )
    if steps.size > 1 and steps.max() > _LONGEST_PAUSE_STEPS * np.median(steps):
        jump = int(np.argmax(steps))
        raise DatasetError(
            f"{path}:{lines[jump + 1]}: expected a timestamp in seconds,"
            f" got a jump of {steps[jump] / 1e9:g} s (another unit?)"
        )
