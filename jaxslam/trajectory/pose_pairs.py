"""Pairs of poses of a trajectory whose motion is compared, and how far they are apart in time."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class PosePairs(NamedTuple):
    """Pairs of poses, each with the time between its two.

    Attributes:
        first: `(m,)` indices of the earlier poses.
        second: `(m,)` indices of the later poses.
        seconds: `(m,)` time from the earlier to the later pose, positive.
    """

    first: Int[np.ndarray, " m"]
    second: Int[np.ndarray, " m"]
    seconds: Float[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def later_by(cls, timestamps_ns: Int[np.ndarray, " n"], delta_s: float) -> "PosePairs":
        """Each pose with the first one at least this much later, where there is one.

        Args:
            timestamps_ns: Stamps of the poses, strictly increasing.
            delta_s: The least time between the two poses of a pair, seconds.
        """
        second = np.searchsorted(timestamps_ns, timestamps_ns + round(delta_s * 1e9))
        return cls._of(timestamps_ns, np.flatnonzero(second < len(timestamps_ns)), second)

    @classmethod
    def successive(cls, timestamps_ns: Int[np.ndarray, " n"]) -> "PosePairs":
        """Each pose with the next one.

        Args:
            timestamps_ns: Stamps of the poses, strictly increasing.
        """
        index = np.arange(len(timestamps_ns))
        return cls._of(timestamps_ns, index[:-1], index + 1)

    @classmethod
    def _of(cls, timestamps_ns: Int[np.ndarray, " n"], first: np.ndarray, second: np.ndarray) -> "PosePairs":
        second = second[first]
        return cls(first, second, (timestamps_ns[second] - timestamps_ns[first]) * 1e-9)

    def rmse_per_second(self, errors: Float[np.ndarray, " m"]) -> float | None:
        """The RMSE of errors of the pairs, each divided by the time between its two poses; `None` without pairs."""
        return float(np.sqrt(np.mean(np.square(errors / self.seconds)))) if len(self) else None

    def times(self) -> dict[str, float | None]:
        """The `median`, `min` and `max` of the times between two poses of a pair, seconds; `None` without pairs."""
        measures = {"median": np.median, "min": np.min, "max": np.max}
        return {name: float(measure(self.seconds)) if len(self) else None for name, measure in measures.items()}


def spacing(pairs: int, median_s: float | None, least_s: float | None, most_s: float | None) -> str:
    """How many pairs there are and how far they are apart, in words.

    Args:
        pairs: How many there are.
        median_s: Median time between two poses of a pair, seconds; `None` without pairs, as the next two.
        least_s: The shortest such time, seconds.
        most_s: The longest such time, seconds.
    """
    count = "1 pair" if pairs == 1 else f"{pairs} pairs"
    if median_s is None or least_s is None or most_s is None:
        return count
    digits = 2 if median_s >= 1 else 3
    median, least, most = (f"{value:.{digits}f}" for value in (median_s, least_s, most_s))
    if least == most:
        return f"{count}, {most} s apart"
    return f"{count}, {least} to {most} s apart, median {median} s"
