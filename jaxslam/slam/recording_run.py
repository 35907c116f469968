"""Run a tracker over a whole recording."""

import logging
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from jaxslam.config.schema import RunConfig
from jaxslam.datasets import Dataset, imu_samples, prefetch
from jaxslam.datasets.protocol import with_imu
from jaxslam.datasets.realtime import in_real_time
from jaxslam.errors import DatasetError, FrameError, JaxSlamError
from jaxslam.runtime.garbage import garbage_frozen
from jaxslam.sensors.frame import Frame
from jaxslam.slam.argument_checks import check_recording
from jaxslam.slam.frame_records import FrameRecords
from jaxslam.slam.frame_result import FrameRecord, FrameResult, Rejected
from jaxslam.tracking.state import TrackStatus

if TYPE_CHECKING:
    from jaxslam.slam.slam import Slam

_log = logging.getLogger(__name__)


def run_recording(
    slam: "Slam", dataset: Dataset, on_frame: Callable[[Frame | None, FrameResult | Rejected], None] | None = None
) -> FrameRecords:
    """Track every frame of a recording, then wait for mapping to finish.

    A frame that cannot be read or does not fit the camera is reported as `Rejected`, and the run goes on. With
    `run.realtime`, so are frames that come too late, with the status `DROPPED`.

    Args:
        slam: The tracker.
        dataset: The recording; its camera must be that of the tracker.
        on_frame: Called after every frame, for progress and pictures. The frame is `None` if it was unreadable.

    Returns:
        One record per frame, without its arrays.

    Raises:
        DatasetError: If `dataset` is not a recording, or is one of another camera.
    """
    check_recording(dataset, slam.camera)
    slam.warm_up()
    records, samples, last_ns = FrameRecords(), imu_samples(dataset), None
    with garbage_frozen():
        for timestamp_ns, frame in zip(dataset.timestamps_ns, _frames_of(dataset, slam.config.run), strict=True):
            if isinstance(frame, Frame):
                # With those of frames between that could not be read, or came too late.
                frame = with_imu(frame, samples, last_ns)  # noqa: PLW2901
            result = _tracked_or_rejected(slam, int(timestamp_ns), frame)
            last_ns = last_ns if isinstance(result, Rejected) else result.timestamp_ns
            records.append(FrameRecord.of(result))
            if on_frame is not None:
                on_frame(frame if isinstance(frame, Frame) else None, result)
    slam.finish()
    return records


def _frames_of(dataset: Dataset, config: RunConfig) -> Iterator[Frame | JaxSlamError | None]:
    """Read all frames ahead; an error stands for an unreadable frame, and `None` for one that came too late."""
    frames = prefetch(_ErrorsAsValues(dataset), ahead=config.prefetch_frames)
    return in_real_time(frames, dataset.timestamps_ns) if config.realtime else frames


def _tracked_or_rejected(slam: "Slam", timestamp_ns: int, frame: Frame | JaxSlamError | None) -> FrameResult | Rejected:
    if frame is None:
        late = FrameError("the next frame was there before there was time for this one")
        return Rejected(timestamp_ns, late, TrackStatus.DROPPED)
    try:
        if not isinstance(frame, JaxSlamError):
            return slam.track(frame)
        error = frame
    except FrameError as unfit:
        error = unfit
    _log.warning("frame at %d ns rejected: %s", timestamp_ns, error)
    return Rejected(timestamp_ns, error)


class _ErrorsAsValues:
    """A recording that returns the errors of unreadable frames instead of raising them."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame | JaxSlamError:
        try:
            frame: object = self._dataset[index]
        except (DatasetError, FrameError) as error:
            return error
        if not isinstance(frame, Frame):
            return DatasetError(f"frame {index}: expected a jaxslam.Frame, got {type(frame).__name__}")
        return frame
