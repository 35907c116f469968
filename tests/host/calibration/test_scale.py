"""The scale of a recording from a true path or a known length."""

import json

import numpy as np
import pytest

from jaxslam import Camera
from jaxslam.calibration import Calibration, Estimate, ResidualField, Verdict
from jaxslam.calibration.scale import scale_of
from jaxslam.errors import DatasetError
from jaxslam.trajectory.trajectory import Trajectory


def path(count: int = 90, factor: float = 1.0, noise_m: float = 0.0) -> Trajectory:
    t = np.linspace(0, 6, count)
    poses = np.zeros((count, 7))
    poses[:, 0] = 1
    poses[:, 4:] = factor * np.stack([t, np.sin(t), 0.3 * np.cos(2 * t)], axis=1)
    poses[:, 4:] += noise_m * np.random.default_rng(0).normal(size=(count, 3))
    return Trajectory(np.arange(count) * 33_000_000, poses)


def test_true_path_tells_the_scale() -> None:
    scale = scale_of(path(noise_m=0.01), path(factor=1.03))
    assert scale.factor == pytest.approx(1.03, abs=0.004)
    assert 0 < scale.sigma < 0.004


def test_known_length_tells_the_scale() -> None:
    ends = path().T_world_cam[[0, -1], 4:]
    scale = scale_of(path(), 1.1 * float(np.linalg.norm(ends[1] - ends[0])))
    assert scale.factor == pytest.approx(1.1)
    assert np.isnan(scale.sigma)


def test_report_is_json() -> None:
    """What nothing tells is null there."""
    unknown = Estimate("baseline_m", "m", 0.5, 0.5, np.nan, np.nan, Verdict.UNOBSERVABLE)
    nothing = np.zeros((2, 0))
    field = ResidualField(nothing, nothing, nothing, *3 * [np.zeros(0)])
    camera = Camera("pair", 64, 48, 60.0, 60.0, 31.5, 23.5, baseline_m=0.5)
    summary = Calibration(camera, camera, (unknown,), 0.0, 0.1, 1.0, 4, 40, 1, field).summary()
    (parameter,) = json.loads(json.dumps(summary, allow_nan=False))["parameters"]
    assert (parameter["found"], parameter["before"], parameter["verdict"]) == (None, 0.5, "unobservable")


def test_errors() -> None:
    there = path().T_world_cam[:40]
    loop = Trajectory(np.arange(80), np.concatenate([there, there[::-1]]))
    with pytest.raises(DatasetError, match="known_length: expected the distance between the first and the last place"):
        scale_of(loop, 2.0)
    with pytest.raises(DatasetError, match="groundtruth: expected 60 poses"):
        scale_of(path(count=30), path(count=30))
