"""Judge by several frames which points of the map are gone, and whether the map has changed."""

from collections import deque

import numpy as np

from jaxslam.geometry.types import Ids
from jaxslam.mapping.vanished_points import VanishedPoints

_NUM_FRAMES = 5
"""Number of frames in a row whose points that are gone add up: a camera that turns sees a chair's place bit by bit."""

_MIN_VANISHED, _MIN_SHARE = 20, 0.005
"""Smallest number of confirmed points that are gone, and smallest share of those in view, for a change of the map. In
the rendered room `changes`, five frames find 29 where a chair was moved, and at most 13 where nothing was."""

_MAX_DOUBTED = 4096
"""Number of points that one frame saw through that are remembered, the newest ones."""


class MapChanges:
    """Collects what frames see through: a point is gone if two of them do, and none in between sees it there.

    A single frame may have a wrong pose, or be blurred. One that sees through much of the map has a wrong pose.

    Attributes:
        pending: Whether the map has changed, and no keyframe was made since.
    """

    def __init__(self) -> None:
        """Start without frames."""
        self.pending = False
        self._nums_gone: deque[int] = deque(maxlen=_NUM_FRAMES)
        self._doubted = np.zeros(0, np.int64)

    def gone(self, vanished: VanishedPoints) -> Ids:
        """Return the ids of the points that are gone, given those that a frame sees through."""
        if vanished.contradict_pose:
            return vanished.ids[:0]
        again = np.isin(vanished.ids, self._doubted)
        self._nums_gone.append(int(np.count_nonzero(again & vanished.confirmed)))
        self.pending |= bool(sum(self._nums_gone) >= max(_MIN_VANISHED, _MIN_SHARE * vanished.num_shown))
        doubted = np.setdiff1d(np.union1d(self._doubted, vanished.ids), vanished.there)
        self._doubted = np.setdiff1d(doubted, vanished.ids[again])[-_MAX_DOUBTED:]
        return vanished.ids[again]

    def keyframe_made(self) -> None:
        """Note that a keyframe shows the change."""
        self.pending = False
        self._nums_gone.clear()
