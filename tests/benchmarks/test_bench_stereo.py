"""Pairs: live on a car beside OpenCV's optical flow alone, how far they drift, and rooms beside measured depth.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_stereo.py -s`
"""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.live import live_run, part_of, show

from jaxslam import Slam, evaluate, load_config, open_dataset
from jaxslam.datasets import Dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.geometry.se3 import between
from jaxslam.trajectory.trajectory import Trajectory

pytestmark = [pytest.mark.benchmark, pytest.mark.usefixtures("opencv_in_one_thread")]

RUNS, NUM_PAIRS, RATE_HZ = 5, 51, 10.0
FIRST_MEASURED = 12
"""Of the true poses of that road. Those before are interpolated: they turn by 0.47 degrees where, by the essential
matrices of the pictures, the car turned by 0.06."""
ROOMS, ROOM_FRAMES, BASELINE_M = 5, 90, 0.1


def test_pairs_take_twice_as_long_as_opencv_flow(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Flow of 500 points of pairs of 1226x370, their depth, regions, the pose, and mapping in its threads."""
    part = part_of(data_dir / "kitti/sequences/06", range(NUM_PAIRS), RATE_HZ)
    runs = [live_run(part) for _ in range(RUNS)]
    show(capsys, "kitti/sequences/06", runs)
    assert np.median([run.median for run in runs]) <= 2.0


def test_drift_on_a_road(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where the last pose is, seen from an earlier one, over the length of the way between; all pairs are tracked."""
    dataset = open_dataset(data_dir / "kitti/sequences/06")
    assert dataset.ground_truth is not None
    drifts = []
    for seed in range(RUNS):
        path = _tracked(dataset, seed)
        assert len(path) == NUM_PAIRS
        of_all, measured = (_drift(path, dataset.ground_truth, first) for first in (0, FIRST_MEASURED))
        drifts.append(measured)
        with capsys.disabled():
            found = evaluate(path, dataset.ground_truth)
            print(
                f"\nseed {seed}: drift from the first pose {100 * of_all:.2f} %, from pose {FIRST_MEASURED}"
                f" {100 * measured:.2f} %; ATE {found.ate_rmse_m:.3f} m, and the end is {found.errors_m[-1]:.3f} m away"
            )
    assert np.median(drifts) <= 0.005


@pytest.mark.parametrize("path", ["xyz", "rpy", "halfsphere"])
def test_rooms_beside_measured_depth(path: CameraPathKind, capsys: pytest.CaptureFixture[str]) -> None:
    errors_m = np.zeros((2, ROOMS))
    for room in range(ROOMS):
        for kind, baseline_m in enumerate((None, BASELINE_M)):
            config = SyntheticConfig(frames=ROOM_FRAMES, people=0, path=path, seed=room, baseline_m=baseline_m)
            dataset = SyntheticDataset(config)
            errors_m[kind, room] = evaluate(_tracked(dataset, room), dataset.ground_truth).ate_rmse_m
    depth_m, pairs_m = np.median(errors_m, 1)
    with capsys.disabled():
        print(f"\n{path}: ATE in mm with measured depth and in pairs, by room")
        print(np.round(1e3 * errors_m, 2))
        print(f"medians {1e3 * depth_m:.2f} and {1e3 * pairs_m:.2f}, ratio {pairs_m / depth_m:.2f}")
    assert pairs_m <= 1.5 * depth_m


def _tracked(dataset: Dataset, seed: int) -> Trajectory:
    with Slam(dataset.camera, load_config(overrides=["semantics.model=null", f"run.seed={seed}"])) as slam:
        slam.run(dataset)
        return slam.trajectory


def _drift(path: Trajectory, truth: Trajectory, first: int) -> float:
    true = truth.T_world_cam[: len(path)]
    apart = between(between(true[first], true[-1]), between(path.T_world_cam[first], path.T_world_cam[-1]))
    return float(np.linalg.norm(apart[4:]) / np.linalg.norm(np.diff(true[first:, 4:], axis=0), axis=1).sum())
