"""Depth in some frames only, or in a part of each: a low rate, a sensor that fails for a while, and its reach."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from jaxslam_kernels.se3 import to_camera
from real_networks import real_network
from room_round import SETTINGS

from jaxslam import Camera, Config, Frame, FrameResult, KeyframeReason, Slam, TrackReason, TrackStatus, load_config
from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory
from jaxslam.worlds.library import load_world
from jaxslam.worlds.stored_world import StoredWorld

CONFIG = load_config("default", overrides=["semantics.model=null", *SETTINGS])
"""For the room; its tracker is that of other tests."""
LARGE = load_config("default", overrides=["semantics.model=null"])


@functools.cache
def room() -> tuple[SyntheticDataset, tuple[Frame, ...]]:
    made = SyntheticDataset(SyntheticConfig(width=320, height=240, frames=45, people=1, path="xyz", fps=15.0))
    return made, tuple(made[index] for index in range(len(made)))


def without_depth(frame: Frame) -> Frame:
    return dataclasses.replace(frame, depth_m=None)


def tracked(
    change: Callable[[int, Frame], Frame], camera: Camera, frames: tuple[Frame, ...], config: Config = CONFIG
) -> list[FrameResult]:
    with Slam(camera, config) as slam:
        return [slam.track(change(index, frame)) for index, frame in enumerate(frames)]


def error_m(results: list[FrameResult], truth: Trajectory) -> float:
    times_ns = np.array([result.timestamp_ns for result in results])
    return evaluate(Trajectory(times_ns, np.stack([result.T_world_cam for result in results])), truth).ate_rmse_m


def test_every_third_frame() -> None:
    """Keyframes are those with depth."""
    source, frames = room()
    whole = tracked(lambda _, frame: frame, source.camera, frames)
    some = tracked(lambda index, frame: without_depth(frame) if index % 3 else frame, source.camera, frames)
    assert all(result.status != TrackStatus.LOST for result in some)
    assert {index % 3 for index, result in enumerate(some) if result.keyframe != KeyframeReason.NONE} == {0}
    errors_m = [error_m(results, source.ground_truth) for results in (whole, some)]
    print("error in mm with all depth, with a third:", 1e3 * np.array(errors_m))
    assert errors_m[1] < 0.005


def test_none_is_as_depth_without_a_pixel() -> None:
    source, frames = room()
    blank = np.zeros((source.camera.height, source.camera.width), np.float32)
    none = tracked(lambda i, frame: without_depth(frame) if i % 2 else frame, source.camera, frames[:12])
    holes = [blank, np.full_like(blank, np.nan)]
    for hole in holes:
        change = lambda i, frame, hole=hole: dataclasses.replace(frame, depth_m=hole) if i % 2 else frame
        for one, other in zip(none, tracked(change, source.camera, frames[:12]), strict=True):
            np.testing.assert_array_equal(one.T_world_cam, other.T_world_cam)
            np.testing.assert_array_equal(one.dynamic_mask, other.dynamic_mask)


def test_start_waits_for_depth() -> None:
    source, frames = room()
    results = tracked(lambda index, frame: without_depth(frame) if index < 3 else frame, source.camera, frames[:6])
    lost, started, ok = TrackStatus.LOST, TrackStatus.STARTED, TrackStatus.OK
    assert [result.status for result in results] == [lost, lost, lost, started, ok, ok]
    assert {result.reason for result in results[:3]} == {TrackReason.NO_DEPTH.text}


def test_a_sensor_that_fails_for_a_second() -> None:
    """Points of known depth carry the pose; no keyframe is made until there is depth again."""
    source, frames = room()
    results = tracked(lambda i, frame: without_depth(frame) if 10 <= i < 25 else frame, source.camera, frames)
    assert all(result.status != TrackStatus.LOST for result in results)
    assert all(result.keyframe == KeyframeReason.NONE for result in results[10:25])
    print("error in mm:", 1e3 * error_m(results, source.ground_truth))
    assert error_m(results, source.ground_truth) < 0.01


def test_parallax_beyond_the_reach_of_the_sensor() -> None:
    """Half of the room has no depth: points there are located as the camera moves, and hold it."""
    source = SyntheticDataset(SyntheticConfig(width=320, height=240, frames=30, people=0, path="halfsphere", fps=15.0))
    rendered = [source.render(index) for index in range(len(source))]
    reach_m = float(np.median(rendered[0].exact_depth_m))
    with Slam(source.camera, CONFIG) as slam:
        for one in rendered:
            within = np.where(one.exact_depth_m < reach_m, one.depth_m, 0)
            result = slam.track(dataclasses.replace(one.measured, depth_m=within))
            assert result.status in (TrackStatus.STARTED, TrackStatus.OK)
        state = slam._tracker.state
    column, row = np.round(np.asarray(state.points.uv)).astype(int)
    true_m = rendered[-1].exact_depth_m[row, column]
    beyond = np.asarray(state.points.valid & state.points.has_position()) & (true_m > 1.1 * reach_m)
    depth_m = np.asarray(to_camera(state.T_world_cam, state.points.X_world))[2]
    error = np.abs(depth_m[beyond] / true_m[beyond] - 1)
    print(f"{beyond.sum()} points beyond {reach_m:.2f} m, median error of their depth {100 * np.median(error):.1f} %")
    assert beyond.sum() > 20
    assert np.median(error) < 0.1


@pytest.mark.slow
def test_a_sensor_that_fails_on_the_way() -> None:
    """Almost three seconds in a corridor: points of before leave the picture, and parallax locates new ones."""
    corridor = load_world("corridor")
    camera = dataclasses.replace(corridor.camera, width=480, height=360)
    source = StoredWorld(dataclasses.replace(corridor, camera=camera))
    frames = tuple(source[index] for index in range(120))
    change = lambda i, frame: without_depth(frame) if 30 <= i < 110 else frame
    results = tracked(change, source.camera, frames, LARGE)
    assert all(result.status in (TrackStatus.OK, TrackStatus.STARTED) for result in results)
    way_m = np.linalg.norm(results[110].T_world_cam[4:] - results[30].T_world_cam[4:])
    print(f"way without depth {way_m:.2f} m, error {1e3 * error_m(results, source.ground_truth):.1f} mm")
    assert way_m > 1.5
    assert error_m(results, source.ground_truth) < 0.03 * way_m


@pytest.mark.slow
@pytest.mark.parametrize("every", [3, 5, 10])
def test_in_a_crowd(data_dir: Path, every: int) -> None:
    """Bonn `crowd`, in the median of three seeds."""
    folder = data_dir / "bonn" / "rgbd_bonn_crowd"
    if not folder.is_dir():
        pytest.skip(f"JAXSLAM_DATA holds no {folder.name}")
    dataset, model = open_dataset(folder), real_network("yolox_nano")
    assert dataset.ground_truth is not None
    errors_m = []
    for seed in range(3):
        config: Config = load_config("default", overrides=[f"semantics.model={model}", f"run.seed={seed}"])
        with Slam(dataset.camera, config) as slam:
            results = []
            for index in range(len(dataset)):
                frame = dataset[index]
                results.append(slam.track(without_depth(frame) if index % every else frame))
        assert sum(result.status == TrackStatus.LOST for result in results) <= 0.01 * len(dataset)
        errors_m.append(error_m(results, dataset.ground_truth))
    print(every, "error in mm:", 1e3 * np.array(errors_m))
    assert np.median(errors_m) <= 0.016
