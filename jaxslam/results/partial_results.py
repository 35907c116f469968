"""Results that are written while a recording is tracked, for a run that is killed before its end."""

import csv
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from jaxslam.errors import TrajectoryError
from jaxslam.results.frame_table import COLUMNS, frame_row
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameRecord, FrameResult, Rejected
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.trajectory import tum_line

PARTIAL_FILES = ("frames.partial.csv", "trajectory_online.partial.txt")
"""The files while they grow. The whole ones, without `partial` in their names, replace them at the end of a run."""
_FLUSH_S = 1.0
"""Longest time for which what a frame gave is not in the files."""


class PartialResults:
    """Writes the record and the pose of each frame as they come: an `on_frame` of `Slam.run`.

    It is a context manager: if the block ends without an error, the whole files are there, and these are removed.
    """

    def __init__(self, folder: Path) -> None:
        """Write into a folder, over what an earlier run that was killed left there.

        Raises:
            TrajectoryError: If a file cannot be written.
        """
        self._paths = [folder / name for name in PARTIAL_FILES]
        self._files = ExitStack()
        try:
            opened = [self._files.enter_context(path.open("w", newline="")) for path in self._paths]
        except OSError as problem:
            self._files.close()
            raise TrajectoryError(f"{folder}: cannot be written: {problem.strerror}") from None
        self._table, self._trajectory = opened
        self._rows = csv.writer(self._table, lineterminator="\n")
        self._rows.writerow(COLUMNS)
        self._flushed = time.monotonic()

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Add one frame.

        Raises:
            TrajectoryError: If it cannot be written.
        """
        try:
            self._rows.writerow(frame_row(FrameRecord.of(result)))
            if isinstance(result, FrameResult) and result.status != TrackStatus.LOST and result.in_map_frame:
                self._trajectory.write(tum_line(result.timestamp_ns, result.T_world_cam))
            if time.monotonic() - self._flushed > _FLUSH_S:
                self._flushed = time.monotonic()
                self._table.flush()
                self._trajectory.flush()
        except OSError as problem:
            raise TrajectoryError(f"{self._paths[0].parent}: cannot be written: {problem.strerror}") from None

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the files, and remove them unless an error ends the block."""
        self._files.close()
        for path in self._paths if error is None else ():
            path.unlink(missing_ok=True)
