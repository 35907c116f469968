"""Log messages about changes of the tracking status."""

import logging

from jaxslam.slam.frame_result import FrameResult
from jaxslam.tracking.state import TrackStatus

_log = logging.getLogger(__name__)


class StatusLog:
    """Logs losses, relocalizations and new submaps at INFO, once each."""

    def __init__(self) -> None:
        """Start before the first frame."""
        self._was_lost = False

    def look(self, number: int, tracked: FrameResult, lost_s: float) -> None:
        """Log what changed with a frame.

        Args:
            number: Number of the frame.
            tracked: Result of the frame.
            lost_s: Time since the last frame that was tracked, in seconds.
        """
        was_lost, self._was_lost = self._was_lost, tracked.status == TrackStatus.LOST
        if self._was_lost and not was_lost:
            _log.info("frame %d: lost: %s", number, tracked.reason)
        elif tracked.status == TrackStatus.RELOCALIZED:
            _log.info("frame %d: relocalized in submap %d after %.2f s", number, tracked.submap, lost_s)
        elif tracked.status == TrackStatus.STARTED:
            _log.info("frame %d: submap %d begins", number, tracked.submap)
