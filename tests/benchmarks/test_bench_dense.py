"""The dense map of a crowd: what a keyframe takes on one core, how few points, and how many of them are people.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_dense.py -s`
"""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from true_surface import accuracy

from jaxslam import Slam, load_config, open_dataset
from jaxslam.benchmark.reference_flow import corners_of, flow_ms
from jaxslam.benchmark.timing import pinned_to_one_core
from jaxslam.datasets import Dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.geometry.se3 import inverse, transform
from jaxslam.semantics import load_detector
from jaxslam.sensors.frame import Frame, to_gray
from jaxslam.trajectory.trajectory import Trajectory

pytestmark = [pytest.mark.benchmark, pytest.mark.usefixtures("opencv_in_one_thread")]

RUNS = 5
EVERY, FIRST = 10, 7
"""Frames that ghosts are looked for in. None has a look at what is not there any more, as every fifth frame does."""
AT_DEPTH_M, AT_DEPTH_SHARE = 0.03, 0.03
FLOW_EVERY = 25
LK_RATIO = 20 / 10.5
"""20 ms a keyframe, where OpenCV's flow of 1000 points takes 10.5 between the frames of a run (AMD EPYC, 10.0 to
10.9)."""


def test_of_a_crowd(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = open_dataset(data_dir / "bonn/rgbd_bonn_crowd")
    networks = [
        Path(os.environ.get("JAXSLAM_MODELS") or "nowhere", name)
        for name in ("yolox_nano.onnx", "deeplabv3_mobilenetv2_voc.onnx")
    ]
    if not all(network.is_file() for network in networks):
        pytest.skip("JAXSLAM_MODELS is not set, or does not hold the networks")
    finds, segments = networks
    people = _people(dataset, segments)
    ratios, shares, ghosts = [], [], []
    for seed in range(RUNS):
        settings = ["dense.enabled=true", f"semantics.model={finds}", f"run.seed={seed}"]
        with Slam(dataset.camera, load_config(overrides=settings)) as slam, pinned_to_one_core():
            flow = _FlowBeside()
            slam.run(dataset, flow)
            lk_ms = float(np.median(flow.ms))
            cloud, ms = slam.dense, slam.times.ms["dense"]
            assert cloud is not None
            assert slam.dense_mapping is not None
            made = slam.dense_mapping.figures()
            ghost = _ghosts(cloud.points, dataset, slam.trajectory, people)
        ratios.append(np.median(ms) / lk_ms)
        shares.append(len(cloud.points) / made.measured)
        ghosts.append(ghost)
        with capsys.disabled():
            print(
                f"\nseed {seed}: {made.keyframes} keyframes, median {np.median(ms):.1f} ms, p95"
                f" {np.percentile(ms, 95):.1f} ms on one core, OpenCV's flow of 1000 points {lk_ms:.1f} ms;"
                f" {len(cloud.points)} of {made.measured} points, {100 * shares[-1]:.1f} %, {cloud.megabytes:.1f} MB;"
                f" ghosts {100 * ghost:.3f} %",
                flush=True,
            )
    assert np.median(ratios) <= LK_RATIO
    assert max(shares) <= 0.25
    assert max(ghosts) < 0.005


@pytest.mark.parametrize("path", ["xyz", "rpy", "halfsphere"])
def test_of_a_rendered_room(capsys: pytest.CaptureFixture[str], path: CameraPathKind) -> None:
    """How near the points are to the true surface, and how much of it is covered, where the camera was tracked."""
    found = []
    for seed in range(RUNS):
        source = SyntheticDataset(SyntheticConfig(frames=60, people=0, path=path, seed=seed))
        with Slam(source.camera, load_config(overrides=["dense.enabled=true", "semantics.model=null"])) as slam:
            slam.run(source)
            assert slam.dense is not None
            found.append(accuracy(slam.dense.points, source))
    with capsys.disabled():
        each = ", ".join(f"{100 * mean_m:.2f} cm {100 * coverage:.1f} %" for mean_m, coverage in found)
        print(f"\n{path}: mean distance from the surface and coverage, by seed: {each}")
    assert max(mean_m for mean_m, _ in found) <= 0.015
    assert min(coverage for _, coverage in found) >= 0.9


class _FlowBeside:
    """Times OpenCV's flow between frames of a run, in its thread."""

    def __init__(self) -> None:
        self.ms: list[float] = []
        self._frames = 0
        self._last: np.ndarray | None = None

    def __call__(self, frame: Frame | None, _: object) -> None:
        if frame is not None and self._last is not None and self._frames % FLOW_EVERY == 0:
            before = to_gray(self._last)
            self.ms.append(flow_ms(before, to_gray(frame.image), corners_of(before)))
        self._frames, self._last = self._frames + 1, None if frame is None else frame.image


def _people(dataset: Dataset, segments: Path) -> dict[int, np.ndarray]:
    """Masks of people in frames that ghosts are looked for in."""
    person, masks = load_detector(segments, labels=("person",)), {}
    for index in range(FIRST, len(dataset), EVERY):
        masks[index] = person(dataset[index].image).class_mask
        assert masks[index] is not None
    return masks


def _ghosts(points: np.ndarray, dataset: Dataset, path: Trajectory, people: dict[int, np.ndarray]) -> float:
    """Share of points that are there because of a person.

    Where one is seen, at its depth, it is more often within a mask of people than outside.
    """
    camera = dataset.camera
    inside, outside = np.zeros(len(points), int), np.zeros(len(points), int)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    for index, mask in people.items():
        row = np.searchsorted(path.timestamps_ns, dataset.timestamps_ns[index])
        if path.timestamps_ns[min(row, len(path) - 1)] != dataset.timestamps_ns[index]:
            continue  # it was lost
        depth_m = dataset[index].depth_m
        assert depth_m is not None
        X = transform(inverse(path.T_world_cam[row]), points.T.astype(float))
        ahead = np.flatnonzero(X[2] > 0.1)
        pixels, _ = cv2.projectPoints(X[:, ahead].T, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))
        column, line = np.rint(pixels[:, 0].T).astype(int)
        there = (column >= 0) & (column < camera.width) & (line >= 0) & (line < camera.height)
        # Far out of the picture, distortion may lead back into it.
        there &= (np.abs(X[0, ahead]) < X[2, ahead]) & (np.abs(X[1, ahead]) < X[2, ahead])
        ahead, column, line = ahead[there], column[there], line[there]
        z = X[2, ahead]
        seen = np.abs(depth_m[line, column] - z) < AT_DEPTH_M + AT_DEPTH_SHARE * z
        inside[ahead[seen & mask[line, column]]] += 1
        outside[ahead[seen & ~mask[line, column]]] += 1
    return float(np.mean(inside > outside))
