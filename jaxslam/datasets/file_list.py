"""Lists of images with their times, such as `rgb.txt`: one `timestamp file` a line, seconds, `#` comments."""

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from jaxslam.errors import DatasetError

_MOST_SECONDS = 10**10  # the year 2286; a larger number counts milli-, micro- or nanoseconds
_LONGEST_PAUSE_STEPS = 10**6  # nine hours at 30 frames a second; a longer one is a change of unit


@dataclass(frozen=True)
class FileList:
    """Images in the order of time.

    Attributes:
        source: The file the list was read from.
        timestamps_ns: `(n,)` int64 nanoseconds, strictly increasing.
        files: One path an image.
    """

    source: Path
    timestamps_ns: np.ndarray
    files: tuple[Path, ...]


def read_file_list(path: Path) -> FileList:
    """Read a list; the files it names are relative to its folder, and are not opened.

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
        timestamps.append(_nanoseconds(fields[0], f"{path}:{number}"))
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


def _nanoseconds(text: str, place: str) -> int:
    """Exact: a float would lose the last digits of epoch seconds."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise DatasetError(f"{place}: expected a timestamp in seconds, got '{text}'") from None
    if not seconds.is_finite() or not 0 <= seconds < _MOST_SECONDS:
        raise DatasetError(f"{place}: expected a timestamp in seconds, got '{text}' (another unit?)")
    return int((seconds * 10**9).to_integral_value())


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
