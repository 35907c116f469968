"""Seconds between frames, from time stamps as they come: regular, with jitter, in bursts, or of a clock that was set.

Stamps taken when a frame arrives tell little of when it was exposed: over USB or ROS, frames come in bursts, two of
them 1 ms apart and then none for 66 ms. Taken at their word, a camera at walking pace moves at 30 m/s every other
frame. So as soon as the last stamps fit no frame rate, the clock counts periods instead, and stamps only tell how many
have gone. Those that do fit are taken as they are.
"""

from collections import deque

from jaxslam.errors import FrameError
from jaxslam.slam.input_warnings import InputWarnings

_WINDOW, _LONG_WINDOW, _FEW = 16, 32, 4
"""Intervals that decide whether stamps have become irregular, and whether they are regular again; and the fewest of
which the median is a rate."""
_OFF, _MAX_ODD = 0.25, 2
"""An interval further from a whole number of periods is odd, in periods; so many odd ones are chance. TUM fr1_rpy has 1
of 159 further than 0.2, Bonn crowd and KITTI none."""
_SHORTEST = 0.5
"""Periods: no camera takes two frames closer together."""
_NEAR_NOMINAL = 0.25
"""Share by which the mean interval may differ from the camera's nominal period to be taken for it."""
_GAP_S = 1.0
"""A longer interval is a pause: it says nothing of the rate."""
_FASTEST_S = 1e-3
"""Of shorter periods there are no cameras."""
_MAX_AHEAD = 4.0
"""Periods that the clock may be ahead of the stamps: about the longest burst."""
_SET_BACK_S, _SET_BACK_FRAMES = 0.5, 3
"""A clock was set back if so many frames in a row come in order, each so far before the last one that was tracked."""
_DEPTH_APART_S = 1.0
"""Depth further from its image in time is of another clock."""
_UNITS = {1e-3: "microseconds", 1e-6: "milliseconds", 1e3: "picoseconds"}

_NOTHING_ASKED: tuple[int | None, tuple[float, float, bool]] = None, (0.0, 0.0, False)


class FrameClock:
    """Tells the seconds from frame to frame, refuses stamps that cannot be, and names those that look wrong.

    Attributes:
        last_ns: Stamp of the last frame that was taken; `None` before the first, and after the clock was set back.
    """

    def __init__(self, fps: float, warnings: InputWarnings) -> None:
        """Begin before the first frame.

        Args:
            fps: Nominal frames a second of the camera, until stamps tell the rate.
            warnings: Collector of warnings about the timestamps.
        """
        self._nominal_s = 1 / fps
        self._warnings = warnings
        self.last_ns: int | None = None
        self._intervals_s: deque[float] = deque(maxlen=_LONG_WINDOW)
        self._ahead_s, self._irregular = 0.0, False
        self._refused_ns: list[int] = []
        self._offset_ns = 0
        self._asked = _NOTHING_ASKED

    def check(self, timestamp_ns: int, depth_timestamp_ns: int | None = None) -> None:
        """Refuse a frame whose time cannot be: not later than the last one, or of a depth image of another time.

        The third of frames in a row that are in order, but earlier than the last one tracked by half a second or more,
        is not refused: the clock was set back, or the last one's stamp was wrong, and time goes on from there.

        Raises:
            FrameError: If the frame is to be left out.
        """
        if depth_timestamp_ns is not None and abs(depth_timestamp_ns - timestamp_ns) > _DEPTH_APART_S * 1e9:
            raise FrameError(
                f"depth_timestamp_ns: expected within {_DEPTH_APART_S:g} s of timestamp_ns, got"
                f" {(depth_timestamp_ns - timestamp_ns) / 1e9:+.3f} s; are both of one clock?"
            )
        if self.last_ns is None or timestamp_ns > self.last_ns:
            self._refused_ns.clear()
            return
        back_s = (self.last_ns - timestamp_ns) / 1e9
        if back_s < _SET_BACK_S or (self._refused_ns and timestamp_ns <= self._refused_ns[-1]):
            self._refused_ns.clear()
        if back_s >= _SET_BACK_S:
            self._refused_ns.append(timestamp_ns)
        if len(self._refused_ns) >= _SET_BACK_FRAMES:
            self._set_back(timestamp_ns, back_s)
            return
        hint = (
            f"; if the clock was set back, go on: the {_SET_BACK_FRAMES}rd such frame in a row is tracked"
            if self._refused_ns
            else ""
        )
        raise FrameError(
            f"timestamp_ns: expected more than the last frame's {self.last_ns}, got {timestamp_ns}"
            f" ({back_s:.6f} s back){hint}"
        )

    def elapsed_s(self, timestamp_ns: int) -> float:
        """Seconds from the last frame to one with this stamp; a nominal period for the first one."""
        self._asked = timestamp_ns, self._advanced(timestamp_ns)
        return self._asked[1][0]

    def advance(self, timestamp_ns: int) -> None:
        """Take a frame with this stamp for the last one."""
        asked_ns, advanced = self._asked
        _, self._ahead_s, self._irregular = advanced if asked_ns == timestamp_ns else self._advanced(timestamp_ns)
        self._asked = _NOTHING_ASKED
        if self.last_ns is not None:
            interval_s = (timestamp_ns - self.last_ns) * 1e-9
            if interval_s > 0:
                self._intervals_s.append(interval_s)
                self._look_at_unit()
        self.last_ns = timestamp_ns

    def continuous_ns(self, timestamp_ns: int) -> int:
        """The stamp on a clock that was never set back."""
        return timestamp_ns + self._offset_ns

    def _advanced(self, timestamp_ns: int) -> tuple[float, float, bool]:
        """Seconds from the last frame; how far the clock is ahead of this stamp then; whether stamps are irregular."""
        if self.last_ns is None:
            return self._nominal_s, 0.0, False
        interval_s = (timestamp_ns - self.last_ns) * 1e-9
        if interval_s > _GAP_S:
            return interval_s, 0.0, self._irregular
        known = [step for step in (*self._intervals_s, interval_s) if step <= _GAP_S]
        period_s = self._regular_period(known)
        if period_s is not None:
            return (interval_s if interval_s >= _SHORTEST * period_s else period_s), 0.0, False
        period_s = self._mean_period(known)
        if sum(known) < _FASTEST_S * len(known):
            return period_s, 0.0, False  # no camera is so fast: another unit
        self._warnings.warn(
            "timestamp_ns",
            f"timestamp_ns: expected times of exposure, got intervals from {1e3 * min(known):.3g} to"
            f" {1e3 * max(known):.3g} ms; taken on arrival? {1e3 * period_s:.3g} ms a frame are assumed",
        )
        periods = max(1, round((interval_s - self._ahead_s) / period_s))
        ahead_s = self._ahead_s + periods * period_s - interval_s
        return periods * period_s, min(max(ahead_s, 0.0), _MAX_AHEAD * period_s), True

    def _regular_period(self, intervals_s: list[float]) -> float | None:
        """The period that nearly all intervals are multiples of, the nominal one or their median; `None` if neither.

        Once stamps are irregular, nearly all will not do: it must be all.
        """
        if len(intervals_s) < _FEW:
            return self._nominal_s
        intervals_s = intervals_s[-(_LONG_WINDOW if self._irregular else _WINDOW) :]
        middle_s = sorted(intervals_s)[len(intervals_s) // 2]
        candidates = [self._nominal_s]
        if middle_s >= max(_FASTEST_S, sum(intervals_s) / len(intervals_s) / 2):
            candidates.append(middle_s)
        odd = {period_s: _num_odd(intervals_s, period_s) for period_s in candidates}
        best = min(candidates, key=lambda period_s: odd[period_s])
        return best if odd[best] <= (0 if self._irregular else _MAX_ODD) else None

    def _mean_period(self, intervals_s: list[float]) -> float:
        """The nominal period if the mean interval is near, or of no camera; else the mean interval."""
        mean_s = sum(intervals_s) / len(intervals_s)
        near = abs(mean_s / self._nominal_s - 1) < _NEAR_NOMINAL
        return self._nominal_s if near or mean_s < _FASTEST_S else mean_s

    def _look_at_unit(self) -> None:
        """Say which unit the stamps seem to have, if not nanoseconds."""
        if len(self._intervals_s) < _FEW:
            return
        mean_s = sum(self._intervals_s) / len(self._intervals_s)
        for factor, unit in _UNITS.items():
            if 0.4 < mean_s / (factor * self._nominal_s) < 2.5:
                self._warnings.warn(
                    "timestamp_ns unit",
                    f"timestamp_ns: expected nanoseconds, got {mean_s * 1e9:.3g} ns a frame where camera.fps says"
                    f" {self._nominal_s * 1e9:.3g}: they look like {unit}",
                )

    def _set_back(self, timestamp_ns: int, back_s: float) -> None:
        """Go on from an earlier time, as if a nominal period had gone."""
        assert self.last_ns is not None
        self._offset_ns += self.last_ns - timestamp_ns + round(self._nominal_s * 1e9)
        self._warnings.warn(
            "clock", f"timestamp_ns: the clock was set back by {back_s:.3f} s; tracking goes on from there"
        )
        self._intervals_s.clear()
        self._refused_ns.clear()
        self.last_ns = None


def _num_odd(intervals_s: list[float], period_s: float) -> int:
    """Count intervals that are not a whole number of periods, or shorter than one."""
    periods = [interval_s / period_s for interval_s in intervals_s]
    return sum(abs(number - max(round(number), 1)) > _OFF for number in periods)
