"""No length is absolute: a scene whose lengths are times a factor, with its sensor, is tracked the same."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from real_networks import real_network
from room_round import SETTINGS

from jaxslam import Camera, Config, Frame, FrameResult, Slam, TrackStatus, load_config
from jaxslam.datasets import Dataset, open_dataset
from jaxslam.datasets.prefetch import Subset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.worlds.library import load_world
from jaxslam.worlds.stored_world import StoredWorld

PRESETS = ("default", "ngd", "trs", "usd", "rts", "occlusion")


def scaled_camera(camera: Camera, factor: float) -> Camera:
    """The same camera with its baseline, if it is a pair, times a factor."""
    if camera.baseline_m is None:
        return camera
    far_m = None if camera.far_depth_m is None else factor * camera.far_depth_m
    return dataclasses.replace(camera, baseline_m=factor * camera.baseline_m, far_depth_m=far_m)


def scaled_sensor(config: Config, factor: float) -> list[str]:
    """The settings of a depth sensor for a scene whose lengths are times a factor."""
    track, tolerance_m = config.track, config.dynamics.trajectory.tolerance_m
    return [
        f"track.depth_sigma_m={track.depth_sigma_m * factor!r}",
        f"track.depth_sigma_per_m2={track.depth_sigma_per_m2 / factor!r}",
        f"track.min_depth_m={track.min_depth_m * factor!r}",
        f"track.max_depth_m={track.max_depth_m * factor!r}",
        f"dynamics.trajectory.tolerance_m={tolerance_m * factor!r}",
    ]


def tracked(
    frames: Sequence[Frame], camera: Camera, factor: float, preset: str = "default", overrides: Sequence[str] = ()
) -> list[FrameResult]:
    """Track frames with their depth times a factor."""
    settings = [*scaled_sensor(load_config(preset), factor), *overrides]
    results = []
    with Slam(scaled_camera(camera, factor), load_config(preset, overrides=settings)) as slam:
        for frame in frames:
            depth_m = None if frame.depth_m is None else frame.depth_m * np.float32(factor)
            results.append(slam.track(dataclasses.replace(frame, depth_m=depth_m)))
    return results


def assert_same(results: Sequence[FrameResult], scaled: Sequence[FrameResult], factor: float) -> None:
    """Compare to the bit: a power of two changes no rounding."""
    for index, (one, other) in enumerate(zip(results, scaled, strict=True)):
        names = ("status", "reason", "keyframe", "num_inliers", "num_matched", "mask_source", "mask_age")
        assert [getattr(one, name) for name in names] == [getattr(other, name) for name in names], index
        np.testing.assert_array_equal(one.T_world_cam[:4], other.T_world_cam[:4], str(index))
        np.testing.assert_array_equal(factor * one.T_world_cam[4:], other.T_world_cam[4:], str(index))
        np.testing.assert_array_equal(one.dynamic_mask, other.dynamic_mask, str(index))


NEW_SURFACES = ["dynamics.new_surfaces=true", "dynamics.cues=[trajectory]"]


@pytest.mark.parametrize(
    ("baseline_m", "factor", "settings"),
    [
        pytest.param(None, 0.25, SETTINGS, id="clusters"),
        pytest.param(None, 0.25, NEW_SURFACES, id="new surfaces", marks=pytest.mark.slow),
        pytest.param(0.12, 16.0, ["dynamics.new_surfaces=false"], id="pair", marks=pytest.mark.slow),
    ],
)
def test_room(baseline_m: float | None, factor: float, settings: list[str]) -> None:
    """Frames until the first adjustment of the map, whose solver rounds in another way."""
    size = {"width": 320, "height": 240, "fps": 15.0}
    room = SyntheticDataset(SyntheticConfig(frames=20, people=2, path="xyz", baseline_m=baseline_m, **size))
    overrides = ["semantics.model=null", *settings]
    frames = [room[index] for index in range(len(room))]
    results, scaled = (tracked(frames, room.camera, f, overrides=overrides) for f in (1.0, factor))
    assert sum(result.status == TrackStatus.OK for result in results) >= 18
    assert baseline_m or sum(result.dynamic_mask.any() for result in results) > 5
    assert_same(results, scaled, factor)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recording", "indices"),
    [("bonn/rgbd_bonn_crowd", range(30)), ("kitti/sequences/06", range(7)), ("kitti/sequences/06", range(0, 18, 3))],
)
@pytest.mark.parametrize("preset", PRESETS)
def test_recordings(data_dir: Path, recording: str, indices: range, preset: str) -> None:
    """With real networks, and on a road with more than 3 m between two frames."""
    if not (data_dir / recording).is_dir():
        pytest.skip(f"JAXSLAM_DATA holds no {recording}")
    overrides = [f"semantics.model={real_network('yolox_nano')}"]
    dataset = open_dataset(data_dir / recording)
    frames = [dataset[index] for index in indices]
    results, scaled = (tracked(frames, dataset.camera, factor, preset, overrides) for factor in (1.0, 4.0))
    assert sum(result.status != TrackStatus.LOST for result in results) >= len(frames) - 1
    assert_same(results, scaled, 4.0)


def world(name: str, factor: float, size: tuple[int, int], frames: int) -> Dataset:
    """The first frames of a rendered world times a factor, with images of another size."""
    described = load_world(name)
    camera = described.camera
    focal = {} if camera.fx is None else {"fx": camera.fx * size[0] / camera.width}
    camera = dataclasses.replace(camera, width=size[0], height=size[1], **focal)
    return Subset(StoredWorld(dataclasses.replace(described, scale=factor, camera=camera)), stop=frames)


WORLDS = {"house": ((320, 240), 240), "kitchen": ((320, 240), 240), "road": ((613, 184), 80)}


@functools.cache
def runs_in(name: str, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Run three seeds in a world.

    Returns:
        `(3, n)` statuses of the frames, and `(3,)` errors divided by the factor, meters.
    """
    dataset, statuses, errors_m = world(name, factor, *WORLDS[name]), [], []
    for seed in range(3):
        settings = [] if dataset.camera.is_stereo else scaled_sensor(load_config("default"), factor)
        config = load_config("default", overrides=["semantics.model=null", f"run.seed={seed}", *settings])
        with Slam(dataset.camera, config) as slam:
            statuses.append([record.status for record in slam.run(dataset)])
            assert dataset.ground_truth is not None
            errors_m.append(evaluate(slam.trajectory, dataset.ground_truth).ate_rmse_m / factor)
    return np.array(statuses), np.array(errors_m)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [10.0, 1 / 3])
def test_worlds(factor: float) -> None:
    """No power of two: rounding differs, and so the maps do. Over worlds and seeds, the errors agree."""
    ratios = []
    for name in WORLDS:
        (statuses, errors_m), (scaled_statuses, scaled_errors_m) = runs_in(name, 1.0), runs_in(name, factor)
        ratios.append(np.log(scaled_errors_m).mean() - np.log(errors_m).mean())
        same = np.mean(statuses == scaled_statuses)
        print(f"{name}: {same:.3f} of the statuses are the same, error in mm", 1e3 * errors_m, 1e3 * scaled_errors_m)
        assert same >= 0.98
    print(f"errors times {np.exp(np.mean(ratios)):.3f}")
    assert abs(np.mean(ratios)) < np.log(1.15)
