"""Rendered frames in files, one a frame, which processes may share."""

import logging
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.errors import DatasetError
from jaxslam.io.atomic_files import replacing

_log = logging.getLogger(__name__)


class FrameFiles:
    """A folder of frames. A file that is damaged counts as missing: its checksums do not fit."""

    def __init__(self, folder: Path) -> None:
        """Name the folder; it is made with the first frame."""
        self.folder = folder

    def has(self, index: int) -> bool:
        """Tell whether there is a file of frame `index`."""
        return self._path(index).exists()

    def read(self, index: int) -> dict[str, Any] | None:
        """Read the arrays of frame `index` by name; `None` if there are none, or the file is damaged."""
        try:
            with self._path(index).open("rb") as file, np.load(file) as arrays:
                return dict(arrays)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as problem:
            _log.warning("%s: damaged, rendered again: %s", self._path(index), problem)
            return None

    def write(self, index: int, arrays: dict[str, Any]) -> int:
        """Write the arrays of frame `index`, and return the size of the file in bytes.

        Raises:
            DatasetError: It cannot be written.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            raise DatasetError(f"{self.folder}: cannot be made: {problem.strerror}") from None
        with replacing(self._path(index), DatasetError) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)
            return file.tell()

    def _path(self, index: int) -> Path:
        return self.folder / f"{index}.npz"


def arrays_of(frame: object) -> dict[str, Any]:
    """Return the fields of a frame that are arrays, by name."""
    return {name: value for name, value in vars(frame).items() if isinstance(value, np.ndarray)}
