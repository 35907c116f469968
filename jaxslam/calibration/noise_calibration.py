"""Noise of a camera from an ordinary recording, so that the covariances of poses are as large as their errors.

The recording is tracked forward and backward. Both runs see the same frames with other points, other keyframes and
another drift, so that the difference of their motions is an error that residuals alone do not show: neighbors share
parts of their errors, and points follow a pose that drifts. How large it is beside the covariances that were given out
tells the factor by which all standard deviations are wrong. It does not tell pixels and depth apart, so the ratio of
their settings stays; the noise of single points, which residuals tell apart, is reported beside.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from jaxslam.calibration.noise_likelihood import (
    PointNoise,
    fit_motions,
    fit_points,
    halves,
    motion_log_likelihood,
)
from jaxslam.calibration.noise_recorder import Disagreements, NoiseRecorder, PointResiduals
from jaxslam.config.schema import Config, TrackConfig
from jaxslam.datasets import Dataset, Subset
from jaxslam.datasets.to_and_fro import ToAndFro
from jaxslam.errors import ConfigError, DatasetError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.slam.slam import Slam
from jaxslam.trajectory.consistency import evaluate_consistency

OnProgress = Callable[[str, int, int], None]
"""Told what is being done, how many steps of it are done, and of how many."""

_NUM_PARTS = 10
"""Parts of a recording, every other one of which is held out."""
_MIN_FRAMES = 40
"""Frames of a recording at least: four in each part."""
_MIN_TRACKED = 0.5
"""Share of the frames that must be tracked, each way."""
_SURE = 1.64
"""Standard deviations by which the factor must differ from one: chance alone lets it in 10 % of cases."""
_SETTLED = math.log(1.1)
"""Largest logarithm of the factor after which a recording is not tracked again."""
_FOLLOWS = 0.5
"""Share of a change of the settings, in logarithms, that covariances must follow."""
_LARGEST_STEP, _LARGEST_CHANGE = 4.0, 20.0
"""Largest factor of one round, and of all."""


class NoiseVerdict(Enum):
    """Outcome of a setting."""

    ACCEPTED = "accepted"
    """Held-out parts of the recording are more likely with it."""
    NO_GAIN = "held-out parts are not more likely"
    """It stays as it was; also where the factor is not surely different from one."""
    AT_BOUND = "at its bound: the covariances do not follow"
    """It changed as far as that made covariances more likely: they are never smaller than the residuals of the points
    say, and no setting changes by more than a factor of 20."""


class NoiseEstimate(NamedTuple):
    """One setting of the noise.

    Attributes:
        name: Name of the setting in `track`.
        before: Value in the beginning.
        after: Value in the result.
        sigma: Standard deviation of `after`, from how much parts of the recording contradict each other.
        of_points: Standard deviation of single points alone, by their residuals, without what many points share; NaN
            without depth.
        verdict: What became of it.
    """

    name: str
    before: float
    after: float
    sigma: float
    of_points: float
    verdict: NoiseVerdict


@dataclass(frozen=True, eq=False)
class NoiseCalibration:
    """Result of `calibrate_noise`.

    Attributes:
        estimates: All settings of the noise that the camera has.
        freedom: Degrees of freedom of the t-distribution of the residuals of points; the fewer, the heavier its tails.
        ratio_before: Ratio of the differences between both runs to the given covariances, as a NEES, with the settings
            as they were: 1 if they are right.
        ratio_after: The same in the last run, with the settings of that.
        nees_before: NEES against the ground truth of the recording with the settings as they were; `None` without.
        nees_after: The same in the last run.
        num_motions: Number of motions that were compared.
        num_frames: Number of frames.
        rounds: Number of times that the recording was tracked, each time forward and backward.
    """

    estimates: tuple[NoiseEstimate, ...]
    freedom: float
    ratio_before: float
    ratio_after: float
    nees_before: float | None
    nees_after: float | None
    num_motions: int
    num_frames: int
    rounds: int

    def settings(self) -> dict[str, float]:
        """Return the settings that change, by their names in `track`."""
        return {each.name: each.after for each in self.estimates if each.after != each.before}

    def applied(self, config: Config) -> Config:
        """Return settings with those of the noise."""
        return replace(config, track=replace(config.track, **self.settings()))

    def save(self, path: str | Path) -> None:
        """Write a file of settings, for `jaxslam run --config` and `load_config(file=...)`.

        Raises:
            ConfigError: If the file cannot be written.
        """
        text = yaml.safe_dump({"track": self.settings()} if self.settings() else {}, sort_keys=False)
        write_atomically(Path(path), text.encode(), ConfigError)

    def summary(self) -> dict[str, Any]:
        """Return all figures as plain values, for JSON; `None` where nothing tells a number."""
        return {
            "settings": [_plain(each) for each in self.estimates],
            "freedom": self.freedom,
            "ratio_before": self.ratio_before,
            "ratio_after": self.ratio_after,
            "nees_before": self.nees_before,
            "nees_after": self.nees_after,
            "num_motions": self.num_motions,
            "num_frames": self.num_frames,
            "rounds": self.rounds,
        }


class _Tracked(NamedTuple):
    """A recording as tracked forward and backward."""

    residuals: PointResiduals
    motions: Disagreements
    nees: float | None

    @property
    def ratio(self) -> float:
        return float(self.motions.normalized().mean() / 6)


def calibrate_noise(
    dataset: Dataset,
    config: Config | None = None,
    *,
    rounds: int = 3,
    on_progress: OnProgress = lambda *_: None,
) -> NoiseCalibration:
    """Estimate the noise of a camera: `track.pixel_sigma`, and the noise of depth or of disparity.

    Args:
        dataset: The recording: depth images or stereo pairs. Samples of an IMU are not used.
        config: Settings to begin with; those of the default preset if not given.
        rounds: Number of times that the recording is tracked at most, each time forward and backward, with the settings
            found before.
        on_progress: Told what is being done.

    Raises:
        ConfigError: If `rounds` is below 1, or the settings are those of a run in real time or in threads.
        DatasetError: If the recording is too short, or too little of it is tracked.
    """
    if rounds < 1:
        raise ConfigError(f"rounds: expected at least 1, got {rounds}")
    if len(dataset) < _MIN_FRAMES:
        raise DatasetError(f"{dataset.name}: expected at least {_MIN_FRAMES} frames, got {len(dataset)}")
    start = config or Config()
    if not start.run.in_turn:
        raise ConfigError("run.deterministic: expected true, and run.realtime false, so that both ways see every frame")
    first = _track(dataset, start, "tracking, round 1", on_progress)
    search = _Search(1.0, 1.0, first, 1)
    verdict = NoiseVerdict.NO_GAIN
    if _is_told(first.motions):
        search = _search(dataset, start, first, rounds, on_progress)
        verdict = NoiseVerdict.ACCEPTED if _follows(first, search) else NoiseVerdict.AT_BOUND
    points = fit_points(first.residuals)
    estimates = _estimates(dataset.camera.is_stereo, start.track, search.change, points, _spread(search.last.motions))
    return NoiseCalibration(
        estimates=tuple(each._replace(verdict=verdict) for each in estimates),
        freedom=points.freedom,
        ratio_before=first.ratio,
        ratio_after=search.last.ratio,
        nees_before=first.nees,
        nees_after=search.last.nees,
        num_motions=len(first.motions.error),
        num_frames=len(dataset),
        rounds=search.rounds,
    )


class _Search(NamedTuple):
    """Search for the factor of all standard deviations in the settings.

    Attributes:
        change: Factor that was found.
        tracked: Factor with which the recording was tracked last.
        last: What that gave.
        rounds: Number of times that it was tracked.
    """

    change: float
    tracked: float
    last: _Tracked
    rounds: int


def _search(dataset: Dataset, start: Config, first: _Tracked, rounds: int, on_progress: OnProgress) -> _Search:
    """Track a recording again and again until its covariances are right; the last factor found is kept if not."""
    search = _Search(1.0, 1.0, first, 1)
    while True:
        factor = fit_motions(search.last.motions.normalized()).factor
        if search.rounds > 1 and abs(math.log(factor)) < _SETTLED:
            return search
        step = float(np.clip(factor, 1 / _LARGEST_STEP, _LARGEST_STEP))
        change = float(np.clip(search.tracked * step, 1 / _LARGEST_CHANGE, _LARGEST_CHANGE))
        if search.rounds >= rounds:
            return search._replace(change=change)
        changed = replace(start, track=_changed(start.track, change))
        last = _track(dataset, changed, f"tracking, round {search.rounds + 1}", on_progress)
        search = _Search(change, change, last, search.rounds + 1)


def _follows(first: _Tracked, search: _Search) -> bool:
    """Tell if a factor is within its bounds, and covariances have changed by more than half of it."""
    if not 1 / _LARGEST_CHANGE < search.change < _LARGEST_CHANGE:
        return False
    size = lambda tracked: float(np.median(np.linalg.slogdet(tracked.motions.covariance)[1])) / 12
    return search.tracked == 1 or (size(search.last) - size(first)) / math.log(search.tracked) > _FOLLOWS


def _track(dataset: Dataset, config: Config, stage: str, on_progress: OnProgress) -> _Tracked:
    """Track a recording forward and backward."""
    num_frames = len(dataset)
    played = ToAndFro(dataset, 2 * num_frames - 1)
    ways = Subset(played, 0, num_frames), Subset(played, num_frames - 1)
    recorders: list[NoiseRecorder] = []
    for number, way in enumerate(ways):
        with Slam(way.camera, config) as slam:
            recorder, count = NoiseRecorder(slam), 0

            def on_frame(frame, result, recorder=recorder, number=number) -> None:
                nonlocal count
                recorder(frame, result)
                count += 1
                on_progress(stage, number * num_frames + count, 2 * num_frames)

            slam.run(way, on_frame)
        if recorder.num_tracked < _MIN_TRACKED * num_frames:
            raise DatasetError(
                f"{dataset.name}: expected at least half of {num_frames} frames to be tracked,"
                f" got {recorder.num_tracked} {('forward', 'backward')[number]}"
            )
        recorders.append(recorder)
    forward, backward = recorders
    first_ns, second_ns = ways[0].timestamps_ns, ways[1].timestamps_ns[::-1]
    there = forward.disagreements(backward, first_ns, second_ns)
    back = backward.disagreements(forward, second_ns, first_ns)
    motions = Disagreements(*(np.concatenate(pair) for pair in zip(there, back, strict=True)))
    if not len(motions.error):
        raise DatasetError(f"{dataset.name}: expected motions that are tracked forward and backward, got none")
    truth = dataset.ground_truth
    consistency = None if truth is None else evaluate_consistency(forward.log.poses(), truth)
    return _Tracked(forward.residuals(), motions, None if consistency is None else consistency.nees)


def _is_told(motions: Disagreements) -> bool:
    """Tell if the factor surely differs from one, and held-out motions are more likely with it.

    No test by ranks: where the factor is above one, most motions are less likely with it, and a few much more.
    """
    _, first = halves(motions.frames, _NUM_PARTS)
    if first.all() or not first.any():
        return False
    normalized, gain = motions.normalized(), 0.0
    for used in (first, ~first):
        of, held = normalized[used], normalized[~used]
        free, as_assumed = fit_motions(of), fit_motions(of, factor=1.0)
        gain += float((motion_log_likelihood(held, free) - motion_log_likelihood(held, as_assumed)).sum())
    return gain > 0 and abs(math.log(fit_motions(normalized).factor)) > _SURE * _spread(motions)


def _spread(motions: Disagreements) -> float:
    """Return the standard deviation of the logarithm of the factor, by leaving out one part after the other.

    Source: Efron and Stein, "The Jackknife Estimate of Variance", 1981.
    """
    part, _ = halves(motions.frames, _NUM_PARTS)
    normalized = motions.normalized()
    numbers = np.unique(part)
    if len(numbers) < 2:
        return math.nan
    logs = np.array([math.log(fit_motions(normalized[part != number]).factor) for number in numbers])
    return float(np.sqrt((len(logs) - 1) / len(logs) * np.square(logs - logs.mean()).sum()))


def _changed(config: TrackConfig, factor: float) -> TrackConfig:
    """Return settings with all standard deviations times a factor; the loss stays as wide as it is."""
    return replace(
        config,
        pixel_sigma=config.pixel_sigma * factor,
        loss_scale=config.loss_scale / factor,
        depth_sigma_m=config.depth_sigma_m * factor,
        depth_sigma_per_m2=config.depth_sigma_per_m2 * factor,
        disparity_sigma_px=config.disparity_sigma_px * factor,
    )


def _estimates(
    is_stereo: bool, before: TrackConfig, change: float, points: PointNoise, spread: float
) -> tuple[NoiseEstimate, ...]:
    after = _changed(before, change)
    depth = ("disparity_sigma_px",) if is_stereo else ("depth_sigma_m", "depth_sigma_per_m2")
    of_points = {name: points.depth * getattr(before, name) for name in depth}
    of_points = {"pixel_sigma": points.pixel, **of_points, "loss_scale": math.nan}
    estimates = []
    for name, alone in of_points.items():
        old = getattr(before, name)
        new = _rounded(old, getattr(after, name))
        estimates.append(NoiseEstimate(name, old, new, new * spread, alone, NoiseVerdict.NO_GAIN))
    return tuple(estimates)


def _rounded(before: float, after: float) -> float:
    """Return a value with three digits; one that did not change as it was."""
    return before if after == before else float(f"{after:.3g}")


def _plain(estimate: NoiseEstimate) -> dict[str, Any]:
    numbers = {name: value if math.isfinite(value) else None for name, value in list(estimate._asdict().items())[1:-1]}
    return {"name": estimate.name, **numbers, "verdict": estimate.verdict.value}
