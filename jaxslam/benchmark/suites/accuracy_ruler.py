"""The accuracy ruler: whether tracking has become less accurate than a frozen baseline, over recordings and seeds.

One number decides: the geometric mean over recordings of the ratio of median errors, now to baseline. Medians of five
seeds of one recording differ by 7 % without any change; the geometric mean over ten recordings of ten seeds each, of
the short KITTI clip thirty, lies within 3.5 % of 1 in 95 of 100 comparisons where nothing but the seeds differs.
`jaxslam.benchmark.suites.gate` is the quick check of every commit, this is the one of every larger change.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from jaxslam.benchmark.suites.aggregate import by_sequence
from jaxslam.benchmark.suites.baseline import read_baseline
from jaxslam.benchmark.suites.plan import plan_differences
from jaxslam.benchmark.suites.run_names import run_folder
from jaxslam.config.validation import Range, ValidatedConfig
from jaxslam.errors import BenchmarkError, JaxSlamError
from jaxslam.io.atomic_files import write_atomically

MAX_MEAN, MAX_RECORDING = 1.04, 1.15
"""Ratios of median errors that are not worse: of the geometric mean over recordings, and of a single recording."""
_DRAWS, _PERCENT = 4000, (2.5, 97.5)
_NO_NETWORK = "none"


@dataclass(frozen=True)
class Measured(ValidatedConfig):
    """The runs of one recording.

    Attributes:
        frames: Frames of the recording.
        tracked: Frames tracked, summed over the seeds.
        ates_m: ATE RMSE of each seed in their order, meters, after SE(3) alignment.
        trajectories_sha256: Hash of each seed's trajectory file.
        data_sha256: Hash of the recording as `bench` takes it; empty for a rendered room.
        network_sha256: Hash of the network that looked at frames; `none` where none did.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    frames: int
    tracked: int
    ates_m: tuple[Annotated[float, Range(above=0)], ...]
    trajectories_sha256: tuple[str, ...]
    data_sha256: str
    network_sha256: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.ates_m:
            raise BenchmarkError("ates_m: expected the error of at least one seed, got none")

    @property
    def median_m(self) -> float:
        """Median ATE over the seeds, meters."""
        return float(np.median(self.ates_m))

    @property
    def tracked_percent(self) -> float:
        """Share of all frames of all seeds that were tracked."""
        return 100 * self.tracked / (self.frames * len(self.ates_m))


@dataclass(frozen=True)
class AccuracyBaseline(ValidatedConfig):
    """Figures that the ruler compares with.

    Attributes:
        commit: Commit of jaxslam that was measured.
        reason: Reason why these are the figures to compare with.
        machine: CPU, vector instructions and cores.
        versions: Versions of the libraries that computed the figures.
        preset: Preset that was run.
        sequences: Part, camera or rendered room of each recording, from `plan.fingerprint`.
        recordings: Measured figures, by name of the sequence.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    commit: str
    reason: str
    machine: str
    versions: str
    preset: str
    sequences: Mapping[str, Any]
    recordings: Mapping[str, Measured]


@dataclass(frozen=True)
class Compared:
    """One recording now and in the baseline.

    Attributes:
        name: Name of the sequence.
        now: Figures measured now.
        before: Figures of the baseline; `None` for a recording that is new in the suite.
        by_chance: Ratios of medians between which 95 % lie if nothing has changed but the seeds.
    """

    name: str
    now: Measured
    before: Measured | None
    by_chance: tuple[float, float]

    @property
    def ratio(self) -> float | None:
        """Median ATE now, divided by that of the baseline."""
        return None if self.before is None else self.now.median_m / self.before.median_m

    @property
    def equal_runs(self) -> int:
        """Number of seeds whose trajectories are equal to those of the baseline, to the byte."""
        if self.before is None:
            return 0
        pairs = zip(self.now.trajectories_sha256, self.before.trajectories_sha256, strict=False)
        return sum(now == before for now, before in pairs)


@dataclass(frozen=True)
class Accuracy:
    """The reading of the ruler.

    Attributes:
        recordings: Comparisons of the recordings that were run, in the order of the suite.
        mean_ratio: Geometric mean of the ratios; `None` if no recording is in the baseline.
        mean_by_chance: Geometric means between which 95 % lie if nothing has changed but the seeds.
        worse: Reasons why the result is worse than the baseline, one sentence each; empty if it is not.
        left_out: Recordings of the baseline that were not run.
    """

    recordings: tuple[Compared, ...]
    mean_ratio: float | None
    mean_by_chance: tuple[float, float]
    worse: tuple[str, ...]
    left_out: tuple[str, ...]


def measured(results: Sequence[Mapping[str, Any]], out: Path) -> dict[str, Measured]:
    """Collect the runs of a suite by sequence.

    Args:
        results: Results of `bench`, all of one preset.
        out: Folder of the suite's results, which holds the trajectories.

    Raises:
        BenchmarkError: If a run failed or has no error, or if runs of one sequence had other data or networks.
    """
    return {name: _measured(name, runs, out) for name, runs in by_sequence(results).items()}


def compare_accuracy(now: Mapping[str, Measured], sequences: Mapping[str, Any], baseline: AccuracyBaseline) -> Accuracy:
    """Compare figures with a baseline.

    Args:
        now: Figures from `measured`.
        sequences: Part, camera or rendered room of each recording, as in the baseline.
        baseline: Baseline to compare with.

    Raises:
        BenchmarkError: If a recording, a network or the number of seeds differs from the baseline.
    """
    common = [name for name in now if name in baseline.recordings]
    different = plan_differences(*({name: which[name] for name in common} for which in (baseline.sequences, sequences)))
    if different:
        raise BenchmarkError(f"expected the recordings of the baseline; {'; '.join(different)}")
    for name, runs in now.items():
        _check_same(name, runs, baseline.recordings.get(name))
    random = np.random.default_rng(0)
    chances = {name: _log_ratios(runs, random) for name, runs in baseline.recordings.items() if name in now}
    nothing = np.zeros(1)
    rows = tuple(
        Compared(name, runs, baseline.recordings.get(name), _interval(chances.get(name, nothing)))
        for name, runs in now.items()
    )
    ratios = [row.ratio for row in rows if row.ratio is not None]
    mean = float(np.exp(np.mean(np.log(ratios)))) if ratios else None
    by_chance = _interval(np.mean(list(chances.values()), axis=0)) if chances else (1.0, 1.0)
    left_out = tuple(name for name in baseline.recordings if name not in now)
    return Accuracy(rows, mean, by_chance, tuple(_worse(rows, mean)), left_out)


def load_accuracy_baseline(path: Path) -> AccuracyBaseline:
    """Read a baseline.

    Raises:
        BenchmarkError: If the file is missing, is no baseline, or is one that nothing can be compared with.
    """
    baseline = read_baseline(AccuracyBaseline, path, "bench accuracy --update")
    names = list(baseline.recordings)
    if not names or not baseline.recordings.keys() <= baseline.sequences.keys():
        raise BenchmarkError(f"{path}: recordings: expected at least one, each in `sequences`, got {names}")
    return baseline


def save_accuracy_baseline(path: Path, baseline: AccuracyBaseline) -> None:
    """Write a baseline.

    Raises:
        BenchmarkError: If the file cannot be written.
    """
    write_atomically(path, (json.dumps(asdict(baseline), indent=1) + "\n").encode(), BenchmarkError)


def _measured(name: str, runs: Sequence[Mapping[str, Any]], out: Path) -> Measured:
    for run in runs:
        if run["status"] != "done" or run["ate_rmse_m"] is None:
            why = run["problem"] or run.get("evaluation_problem")
            raise BenchmarkError(f"{name}, seed {run['seed']}: expected a run with an ATE, got none: {why}")
    ordered = sorted(runs, key=lambda run: run["seed"])
    seeds = [run["seed"] for run in ordered]
    if seeds != list(range(len(seeds))):
        raise BenchmarkError(f"{name}: expected the seeds 0 to {len(seeds) - 1} of one preset, got {seeds}")
    return Measured(
        frames=int(_same(name, "frames", runs)),
        tracked=sum(int(run["tracked"]) for run in runs),
        ates_m=tuple(float(run["ate_rmse_m"]) for run in ordered),
        trajectories_sha256=tuple(
            _sha256(out / run_folder(name, run["label"], run["seed"]) / "trajectory.txt") for run in ordered
        ),
        data_sha256=_same(name, "data_sha256", runs) or "",
        network_sha256=_same(name, "networks_sha256", runs).get("model") or _NO_NETWORK,
    )


def _same(name: str, figure: str, runs: Sequence[Mapping[str, Any]]) -> Any:
    """Return the value that all runs have in common."""
    for run in runs:
        if run[figure] != runs[0][figure]:
            got = f"{runs[0][figure]} and {run[figure]}"
            raise BenchmarkError(f"{name}: {figure}: expected the same in all runs, got {got}")
    return runs[0][figure]


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as problem:
        raise BenchmarkError(f"{path}: expected the trajectory of a run: {problem.strerror}") from None


def _check_same(name: str, now: Measured, before: Measured | None) -> None:
    """Refuse runs that differ from the baseline in frames, data, network or number of seeds."""
    if before is None:
        return
    for what in ("frames", "data_sha256", "network_sha256"):
        got, expected = getattr(now, what), getattr(before, what)
        if got != expected:
            raise BenchmarkError(f"{name}: {what}: expected {expected} as in the baseline, got {got}")
    if len(now.ates_m) != len(before.ates_m):
        raise BenchmarkError(f"{name}: expected {len(before.ates_m)} seeds as in the baseline, got {len(now.ates_m)}")


def _worse(rows: Sequence[Compared], mean: float | None) -> list[str]:
    found = []
    if mean is not None and mean > MAX_MEAN:
        found.append(f"geometric mean of the ratios {mean:.3f}, expected at most {MAX_MEAN:g}")
    for row in rows:
        if row.before is None or row.ratio is None:
            continue
        if row.ratio > MAX_RECORDING:
            found.append(f"{row.name}: ratio {row.ratio:.3f}, expected at most {MAX_RECORDING:g}")
        if row.now.tracked < row.before.tracked:
            found.append(f"{row.name}: {row.now.tracked} frames tracked over all seeds, expected {row.before.tracked}")
    return found


def _log_ratios(runs: Measured, random: np.random.Generator) -> np.ndarray:
    """`(draws,)` logarithms of the ratio of two medians of seeds drawn from the same runs (bootstrap)."""
    drawn = random.choice(np.array(runs.ates_m), (2, _DRAWS, len(runs.ates_m)))
    first, second = np.log(np.median(drawn, axis=2))
    return first - second


def _interval(log_ratios: np.ndarray) -> tuple[float, float]:
    low, high = np.exp(np.percentile(log_ratios, _PERCENT))
    return float(low), float(high)
