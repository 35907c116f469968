"""Pairs of poses of one trajectory, over which relative errors are computed."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class PosePairs(NamedTuple):
    """Pairs of poses of one trajectory.

    Attributes:
        first: `(m,)` indices of the earlier poses.
        second: `(m,)` indices of the later poses.
        seconds: `(m,)` times from the earlier to the later pose, positive, seconds.
    """

    first: Int[np.ndarray, " m"]
    second: Int[np.ndarray, " m"]
    seconds: Float[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def later_by(cls, timestamps_ns: Int[np.ndarray, " n"], delta_s: float) -> "PosePairs":
        """Pair each pose with the first pose at least `delta_s` later, if there is one.

        Args:
            timestamps_ns: `(n,)` timestamps of the poses, strictly increasing, nanoseconds.
            delta_s: Shortest time between the two poses of a pair, seconds.
        """
        second = np.searchsorted(timestamps_ns, timestamps_ns + round(delta_s * 1e9))
        return cls._of(timestamps_ns, np.flatnonzero(second < len(timestamps_ns)), second)

    @classmethod
    def successive(cls, timestamps_ns: Int[np.ndarray, " n"]) -> "PosePairs":
        """Pair each pose with the next pose.

        Args:
            timestamps_ns: `(n,)` timestamps of the poses, strictly increasing, nanoseconds.
        """
        index = np.arange(len(timestamps_ns))
        return cls._of(timestamps_ns, index[:-1], index + 1)

    @classmethod
    def _of(cls, timestamps_ns: Int[np.ndarray, " n"], first: np.ndarray, second: np.ndarray) -> "PosePairs":
        second = second[first]
        return cls(first, second, (timestamps_ns[second] - timestamps_ns[first]) * 1e-9)

    def rmse_per_second(self, errors: Float[np.ndarray, " m"]) -> float | None:
        """Compute the RMSE of `(m,)` errors, each divided by the time of its pair; `None` without pairs."""
        return float(np.sqrt(np.mean(np.square(errors / self.seconds)))) if len(self) else None

    def statistics_per_second(self, errors: Float[np.ndarray, " m"]) -> dict[str, float | None]:
        """Compute the `mean`, `median` and `std` of `(m,)` errors, each divided by the time of its pair.

        The standard deviation is that of the population, about the mean. Each is `None` without pairs.
        """
        measures, rates = {"mean": np.mean, "median": np.median, "std": np.std}, errors / self.seconds
        return {name: float(measure(rates)) if len(self) else None for name, measure in measures.items()}

    def times(self) -> dict[str, float | None]:
        """Return the `median`, `min` and `max` of the times of the pairs, seconds; each `None` without pairs."""
        measures = {"median": np.median, "min": np.min, "max": np.max}
        return {name: float(measure(self.seconds)) if len(self) else None for name, measure in measures.items()}


def spacing(pairs: int, median_s: float | None, least_s: float | None, most_s: float | None) -> str:
    """Describe the number of pairs and the times between their poses.

    Args:
        pairs: Number of pairs.
        median_s: Median time between the two poses of a pair, seconds; `None` without pairs.
        least_s: Shortest time between the two poses of a pair, seconds; `None` without pairs.
        most_s: Longest time between the two poses of a pair, seconds; `None` without pairs.
    """
    count = "1 pair" if pairs == 1 else f"{pairs} pairs"
    if median_s is None or least_s is None or most_s is None:
        return count
    digits = 2 if median_s >= 1 else 3
    median, least, most = (f"{value:.{digits}f}" for value in (median_s, least_s, most_s))
    if least == most:
        return f"{count}, {most} s apart"
    return f"{count}, {least} to {most} s apart, median {median} s"
