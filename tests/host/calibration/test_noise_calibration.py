"""Noise of a camera: motions of runs made by hand, settings that are written, and a rendered room."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from frame_results import RESULT

from jaxslam import Camera, load_config
from jaxslam.calibration import NoiseCalibration, NoiseEstimate, NoiseVerdict, calibrate_noise
from jaxslam.calibration.noise_likelihood import fit_motions
from jaxslam.calibration.noise_recorder import NoiseRecorder
from jaxslam.config.schema import Config
from jaxslam.datasets import Subset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.errors import ConfigError, DatasetError
from jaxslam.geometry.se3 import IDENTITY, compose, retract
from jaxslam.tracking.state import TrackStatus

CAMERA = Camera.load("tum_fr1")
SIGMA = np.array([2e-3, 3e-3, 4e-3, 1e-3, 1e-3, 2e-3])
STEP_NS = 10**8
MOVED = retract(IDENTITY, np.array([0.5, 0, 0, 0, 0.3, 0]))
TRUE = np.array([retract(IDENTITY, np.array([0.01 * k, 0, 0.02 * k, 0, 0.01 * k, 0])) for k in range(300)])


def _run(poses: np.ndarray, seed: int, corrected: int | None = None) -> tuple[NoiseRecorder, np.ndarray]:
    """A run over poses with errors of `SIGMA`, whose map moves at a frame: its recorder, and the times of frames."""
    rng = np.random.default_rng(seed)
    points = SimpleNamespace(X_world=np.zeros((3, 0)), xy=np.zeros((2, 0)), depth=np.zeros(0))
    slam: Any = SimpleNamespace(camera=CAMERA, config=Config(), points=points)
    recorder, stamps, world = NoiseRecorder(slam), np.arange(len(poses)) * STEP_NS, IDENTITY
    for index, pose in enumerate(poses):
        world = MOVED if index == corrected else world
        result = replace(
            RESULT,
            timestamp_ns=int(stamps[index]),
            T_world_cam=compose(world, retract(pose, SIGMA * rng.normal(size=6))),
            covariance=np.diag(2 * SIGMA**2).astype(np.float32),  # of the motion: both of its ends have errors
            status=TrackStatus.OK if index else TrackStatus.STARTED,
            correction=MOVED if index == corrected else IDENTITY,
            uv=np.zeros((2, 0)),
            followed=np.zeros(0, bool),
        )
        recorder(None, result)
    return recorder, stamps


def test_independent_runs_disagree_by_the_covariances_of_both() -> None:
    forward, stamps = _run(TRUE, 0)
    backward, others = _run(TRUE[::-1], 1)
    found = forward.disagreements(backward, stamps, others[::-1])
    assert found.frames.tolist() == list(range(1, len(TRUE)))
    # Two runs have everything to themselves here, of real ones 60 %.
    assert found.normalized().mean() / 6 == pytest.approx(1 / 0.6, rel=0.15)
    assert fit_motions(found.normalized()).factor == pytest.approx((1 / 0.6) ** 0.5, rel=0.1)


def test_corrections_of_the_map_are_no_motion() -> None:
    forward, stamps = _run(TRUE[:60], 0)
    expected, found = (
        forward.disagreements(_run(TRUE[59::-1], 1, corrected)[0], stamps, stamps[::-1]).error
        for corrected in (None, 40)
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-3


def test_residuals_of_points() -> None:
    """Points a centimeter beyond where the map has them and three pixels aside; one without depth, one dropped."""
    forward, _ = _run(TRUE[:1], 0)
    noise = Config().track
    points: Any = forward._slam.points
    points.X_world = np.array([[0.0, 0, 2]] * 3).T
    forward._X_world = points.X_world
    points.xy, points.depth = np.zeros((2, 3)), np.array([2.01, 0.0, 2.01])
    points.xy[0] = 3 / CAMERA.fx
    seen = {"uv": np.zeros((2, 3)), "weights": np.array([1, 1, 0]), "followed": np.ones(3, bool)}
    forward(None, replace(RESULT, timestamp_ns=STEP_NS, **seen))
    found = forward.residuals()
    np.testing.assert_allclose(found.pixel, [[-3, -3], [0, 0]], atol=1e-9)
    sigma = noise.depth_sigma_m + noise.depth_sigma_per_m2 * 2.01**2
    np.testing.assert_allclose(found.depth, [-0.01 / sigma, np.nan])


def _found(**changes: float) -> NoiseCalibration:
    track = Config().track
    estimates = tuple(
        NoiseEstimate(name, getattr(track, name), value, 0.1 * value, np.nan, NoiseVerdict.ACCEPTED)
        for name, value in changes.items()
    )
    return NoiseCalibration(estimates, 3.0, 0.5, 1.0, None, None, 10, 40, 2)


def test_settings_are_written_and_read(tmp_path: Path) -> None:
    found = _found(pixel_sigma=0.4, depth_sigma_m=Config().track.depth_sigma_m)
    found.save(tmp_path / "noise.yaml")
    loaded = load_config(file=tmp_path / "noise.yaml")
    assert loaded == found.applied(Config())
    assert loaded.track.pixel_sigma == 0.4
    assert found.settings() == {"pixel_sigma": 0.4}
    assert found.summary()["settings"][0] == {
        "name": "pixel_sigma",
        "before": 1.0,
        "after": 0.4,
        "sigma": pytest.approx(0.04),
        "of_points": None,
        "verdict": "accepted",
    }
    _found().save(tmp_path / "same.yaml")
    assert load_config(file=tmp_path / "same.yaml") == Config()
    with pytest.raises(ConfigError):
        found.save(tmp_path / "none" / "noise.yaml")


def test_wrong_input() -> None:
    room = SyntheticDataset(SyntheticConfig(frames=41))
    with pytest.raises(DatasetError, match="expected at least 40 frames, got 3"):
        calibrate_noise(Subset(room, 0, 3))
    with pytest.raises(ConfigError, match="rounds: expected at least 1, got 0"):
        calibrate_noise(room, rounds=0)
    with pytest.raises(ConfigError, match=r"run\.deterministic: expected true, and run\.realtime false"):
        calibrate_noise(room, load_config(overrides=["run.realtime=true"]))


@pytest.mark.slow
def test_assumed_noise_that_is_far_too_large_is_reduced() -> None:
    """Four times the default: the covariances say so, without ground truth, and end closer to the errors."""
    config = load_config(overrides=["track.pixel_sigma=4", "track.loss_scale=0.25", "semantics.model=null"])
    stages: list[str] = []
    room = SyntheticDataset(SyntheticConfig(frames=60, path="rpy"))
    found = calibrate_noise(room, config, on_progress=lambda text, *_: stages.append(text))
    after = {each.name: each for each in found.estimates}
    assert list(after) == ["pixel_sigma", "depth_sigma_m", "depth_sigma_per_m2", "loss_scale"]
    assert after["pixel_sigma"].verdict is NoiseVerdict.ACCEPTED
    assert after["pixel_sigma"].after < 2.5
    assert after["pixel_sigma"].after * after["loss_scale"].after == pytest.approx(1, rel=0.01)
    assert found.nees_before is not None
    assert found.nees_after is not None
    assert abs(np.log(found.nees_after)) < abs(np.log(found.nees_before))
    assert set(stages) == {f"tracking, round {number}" for number in range(1, found.rounds + 1)}
