"""The gate: whether a suite has become worse than it was when somebody last looked at it and said it was good.

Runs are deterministic and have the same seeds, so that on one machine their errors are equal to the last digit as long
as nothing has changed. Times are not, even as ratios to OpenCV's flow, which has a noise of its own: a flow slowed down
by somebody else's work makes a tracker look fast. The least time of flow of all runs of a sequence is what counts, and
beside it the fastest run of each row is compared with the median run of the baseline. Of four suites on a busy
virtual machine, a row differed by 8 % at the median and 22 % at most so; ratios run by run by up to 50 %.

Another processor rounds otherwise, and so do other releases of the compiler: that changes errors as another seed does.
There, what counts as worse is more than the spread over seeds of that row explains, and times of other processors are
left alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxslam.benchmark.machine_names import machine_name, machine_of, versions_of
from jaxslam.benchmark.suites.aggregate import by_sequence, row_name, rows_of
from jaxslam.benchmark.suites.baseline import ATE, Baseline
from jaxslam.errors import BenchmarkError
from jaxslam.runtime.machine import machine
from jaxslam.runtime.threads import usable_cores

_WORSE_ATE, _WORSE_TIME = 0.02, 0.2
"""Shares by which the median error, and the time of the median frame, may be greater."""
_NOISE, _ROUNDING = 4.0, 0.05
"""Where rounding differs: so many standard deviations of the errors over seeds, or this share of them. With XLA held to
AVX2, AVX and SSE4.2 on one processor, errors of `smoke` differ by 0.02, 0.8 and 2.2 % at most."""
SEEDS_OF_NOISE = 8
"""Least number of seeds from which a baseline takes the spread of errors. Of ten seeds of one row, any two could differ
by 0.03 % or by a factor of 3.7: from two, a spread cannot be told."""
_MIN_ATE_M = 1e-5
"""Smaller differences are of no interest to anybody."""
_MIN_PERCENT = 1e-6
_TRACKED, _TIME = "tracked_percent", "time_of_flows"
"""The last: the median frame of a run, in times of optical flow."""


@dataclass(frozen=True)
class Complaint:
    """A figure that has become worse.

    Attributes:
        row: Sequence and label of the row.
        figure: Name of the figure.
        before: Value in the baseline; `None` for a complaint about something other than a figure.
        now: Value now.
    """

    row: str
    figure: str
    before: float | None
    now: float | None

    @property
    def of_time(self) -> bool:
        """Whether it may be chance, and is worth measuring again."""
        return self.figure == _TIME

    def __str__(self) -> str:
        if self.before is None or self.now is None:
            return f"{self.row}: {self.figure}"
        change = f", {100 * (self.now / self.before - 1):+.1f} %" if self.before else ""
        return f"{self.row}: {self.figure} {self.now:.5g}, was {self.before:.5g}{change}"


def make_baseline(
    suite: str,
    presets: Sequence[str],
    runs: int,
    reason: str,
    results: Sequence[Mapping[str, Any]],
    plan: Mapping[str, Any],
    *,
    errors_only: bool = False,
) -> Baseline:
    """Make a baseline from the figures of runs.

    Args:
        suite: Name of the suite, or its file.
        presets: Presets that the suite was run with.
        runs: Number of seeds, from 0, of each sequence and preset whose figures later runs are compared with.
        reason: Reason why these are the figures to compare with.
        results: Results of all runs; those with further seeds add to the spread of errors alone.
        plan: Sequences, presets and runs, from `jaxslam.benchmark.suites.plan.fingerprint`.
        errors_only: Whether to leave out times, so that later runs are not compared by them.

    Raises:
        BenchmarkError: If a run failed, none was made, one has no ATE, or no reason is given.
    """
    check_reason(reason)
    failed = [result for result in results if result["status"] != "done"]
    if failed or not results:
        raise BenchmarkError(f"baseline: expected runs that all ended well, got {len(failed)} of {len(results)} failed")
    figures = _figures_of([result for result in results if result["seed"] < runs], "median")
    if errors_only:
        figures = {row: {key: value for key, value in of.items() if key != _TIME} for row, of in figures.items()}
    machines, versions, noise = machine_of(results), versions_of(results), _noise_of(results)
    return Baseline(suite, tuple(presets), runs, reason, machines, versions, noise, figures, plan)


def check_reason(reason: str) -> None:
    """Refuse an empty reason for new figures.

    Raises:
        BenchmarkError: If the reason is empty.
    """
    if not reason.strip():
        raise BenchmarkError("--update: expected a reason, got none")


def differences(baseline: Baseline, results: Sequence[Mapping[str, Any]]) -> str:
    """Describe how the machine of these runs differs from that of the baseline; empty if it does not."""
    ours = machine_of(results), versions_of(results)
    theirs = baseline.machine, baseline.versions
    return "; ".join(f"{now}, not {before}" for now, before in zip(ours, theirs, strict=True) if now != before)


def runs_at_once(baseline: Baseline) -> int:
    """Return the number of parallel runs: one if times will be compared, or else one per core."""
    has_times = any(_TIME in figures for figures in baseline.rows.values())
    return 1 if has_times and machine_name(machine()) == baseline.machine else usable_cores()


def complaints(baseline: Baseline, results: Sequence[Mapping[str, Any]]) -> list[Complaint]:
    """List what has become worse: errors by over 2 %, tracked frames at all, time by over 20 %; and what is missing.

    Of times, the fastest run is compared.

    On another machine or with other libraries, errors are worse if more so than seeds explain; times of another machine
    are not compared.
    """
    found = [
        Complaint(
            f"{row_name(result['sequence'], result['label'])}, seed {result['seed']}", result["problem"], None, None
        )
        for result in results
        if result["status"] != "done"
    ]
    now = _figures_of(results, "least")
    limits = _limits(baseline, results)
    for row, before in baseline.rows.items():
        if row not in now:
            found.append(Complaint(row, "is missing", None, None))
            continue
        for figure, was in before.items():
            value, limit = now[row].get(figure), limits(row, figure, was)
            if value is None:
                found.append(Complaint(row, f"{figure} is missing", None, None))
            elif not (value >= limit if figure == _TRACKED else value <= limit):  # also if it is not a number
                found.append(Complaint(row, figure, was, value))
    return found


def _figures_of(results: Sequence[Mapping[str, Any]], which_time: str) -> dict[str, dict[str, float]]:
    """By row: the median error, the least share of tracked frames, and the median or least time."""
    done = [run for run in results if run["status"] == "done"]
    flow_ms = {name: min(known) for name, runs in by_sequence(done).items() if (known := _flow_times(runs))}
    figures: dict[str, dict[str, float]] = {}
    for row in rows_of(done):
        of_row = figures[row_name(row["sequence"], row["label"])] = {_TRACKED: row[_TRACKED]["least"]}
        if row[ATE] is not None:
            of_row[ATE] = round(row[ATE]["median"], 7)
        if row["track_ms_median"] is not None and row["sequence"] in flow_ms:
            of_row[_TIME] = round(row["track_ms_median"][which_time] / flow_ms[row["sequence"]], 4)
    return figures


def _flow_times(runs: Sequence[Mapping[str, Any]]) -> list[float]:
    return [run["flow_ms"] for run in runs if run["flow_ms"] is not None]


def _limits(baseline: Baseline, results: Sequence[Mapping[str, Any]]) -> Callable[[str, str, float], float]:
    """A function of row, figure and what it was, that gives the last value which is not worse."""
    same_machine = machine_of(results) == baseline.machine
    same_rounding = same_machine and versions_of(results) == baseline.versions

    def limit(row: str, figure: str, before: float) -> float:
        if figure == _TRACKED:
            return before - _MIN_PERCENT
        if figure == _TIME:
            return before * (1 + _WORSE_TIME) if same_machine else np.inf
        share = _WORSE_ATE if same_rounding else max(_ROUNDING, _NOISE * baseline.noise[row])
        return before * (1 + share) + _MIN_ATE_M

    return limit


def _noise_of(results: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Compute the relative standard deviation of the errors of every row over its seeds; 0 for a single run."""
    errors: dict[str, list[float]] = {}
    for run in results:
        if run.get(ATE) is not None:
            errors.setdefault(row_name(run["sequence"], run["label"]), []).append(run[ATE])
    return {
        row: round(float(np.std(of_row, ddof=1) / np.mean(of_row)), 4) if len(of_row) > 1 else 0.0
        for row, of_row in errors.items()
    }
