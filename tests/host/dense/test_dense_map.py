"""The dense map of the rendered room: its surface, ghosts, corrections, bounds, key objects, and what a run leaves."""

import functools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree
from small_scene import CONFIG, clip
from true_surface import accuracy, true_surface

from jaxslam.config.loading import load_config
from jaxslam.config.schema import Config, DenseConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.datasets.synthetic.dataset import SyntheticFrame
from jaxslam.dense.coverage import SeenArea
from jaxslam.dense.dense_map import DenseMap
from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.dense.render import picture
from jaxslam.errors import ConfigError, MapFileError
from jaxslam.geometry.se3 import IDENTITY, retract
from jaxslam.map.dynamic_removal import DynamicObservations
from jaxslam.map.types import Map, empty_map
from jaxslam.mapping.local_mapping import NewKeyframe, TrackedObservations
from jaxslam.results.dense_results import DENSE_FILES
from jaxslam.results.run_results import RunInfo, write_results
from jaxslam.semantics import Detections
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.slam.dense_thread import DenseMapping
from jaxslam.slam.slam import Slam

EVERY = 12
SMALL = DenseConfig(enabled=True, max_points=150_000, keyframe_points=16_384)
NO_TRACKS = TrackedObservations(np.zeros(0), np.zeros((2, 0)), np.zeros((3, 0)), np.zeros(0))


@functools.cache
def _room(people: int, frames: int = 10) -> tuple[SyntheticDataset, tuple[SyntheticFrame, ...]]:
    """Every twelfth frame of the room."""
    source = SyntheticDataset(SyntheticConfig(width=320, height=240, frames=EVERY * frames, people=people))
    return source, tuple(source.render(EVERY * index) for index in range(frames))


def _mapping(
    source: SyntheticDataset, config: DenseConfig = SMALL, detector=None, *, deterministic: bool = True
) -> DenseMapping:
    dense_map = DenseMap(source.camera, config, nearest_m=0.3, farthest_m=6.0, key_detector=detector)
    seen = SeenArea(source.camera, nearest_m=0.3, farthest_m=6.0)
    return DenseMapping(dense_map, seen, config, deterministic=deterministic)


def _map(source: SyntheticDataset, poses: list[np.ndarray]) -> Map:
    """A map that holds nothing but keyframes."""
    ids = np.arange(len(poses))
    return empty_map(source.camera)._replace(
        ids=ids, T_world_cam=np.stack(poses), parent=ids - 1, submap=np.zeros(len(poses), np.int32)
    )


def _arrays(frame: SyntheticFrame, ignore: np.ndarray | None = None) -> FrameArrays:
    ignore = np.zeros(frame.depth_m.shape, bool) if ignore is None else ignore
    return FrameArrays(frame.rgb[..., 0], frame.depth_m, ignore, np.float32(0), np.float32(0))  # pyright: ignore[reportArgumentType]


def _tracked_at(pose: np.ndarray) -> Any:
    """Of a `TrackOutput`, what a dense map needs."""
    return SimpleNamespace(T_world_cam=SimpleNamespace(wxyz_xyz=pose), twist=np.zeros(6))


def _hand_over(dense: DenseMapping, index: int, frame: SyntheticFrame, ignore: np.ndarray | None = None) -> None:
    new = NewKeyframe(index, frame.timestamp_ns, _arrays(frame, ignore), index - 1, IDENTITY, 0, np.zeros(6), NO_TRACKS)
    dense.insert_keyframe(new, frame.rgb, frame.T_world_cam, EVERY * index)


def _look(dense: DenseMapping, frame: SyntheticFrame) -> None:
    """A look as of a frame between keyframes."""
    dense.frame_tracked(0, frame.rgb, _arrays(frame), _tracked_at(frame.T_world_cam))


def _made(source, frames, config=SMALL, *, masks=False, late=False) -> DenseMapping:
    """The map of frames where they truly were; with true masks of who moves, at once or late. Carved with each too."""
    dense, poses = _mapping(source, config), []
    for index, frame in enumerate(frames):
        who = frame.instance_mask > 0
        _hand_over(dense, index, frame, who if masks and not late else None)
        if config.carve:
            _look(dense, frame)
        poses.append(frame.T_world_cam)
        dense.map_made(_map(source, poses), index, 0)
        if masks and late:
            dense.remove(DynamicObservations(index, who, np.zeros(0, np.int64)), 0)
    dense.finish()
    return dense


def _ghosts(dense: DenseMapping, source, frames) -> float:
    """Share of points that were put there because of a person: on the true surface of one in some frame, within 4 cm,
    and off all that stands still by more than 6 cm. A wall that somebody has stood before is none.
    """
    points = dense.cloud().points
    still, people = (KDTree(true_surface(source, frames, people=who)[::3]) for who in (False, True))
    return float(np.mean((still.query(points)[0] > 0.06) & (people.query(points)[0] < 0.04)))


class TestSurface:
    def test_accuracy_and_coverage(self) -> None:
        source, frames = _room(people=0)
        cloud = _made(source, frames).cloud()
        surface = true_surface(source, frames, people=False)
        assert np.mean(KDTree(surface[::2]).query(cloud.points)[0]) < 0.015
        assert np.mean(KDTree(cloud.points).query(surface[::37])[0] < 0.03) > 0.9
        assert len(cloud.points) < 0.25 * sum(np.count_nonzero(frame.depth_m) for frame in frames)
        assert cloud.points.shape == cloud.colors.shape == (len(cloud.counts), 3)

    @pytest.mark.slow
    @pytest.mark.parametrize(("path", "seed"), [("xyz", 0), ("halfsphere", 1)])
    def test_of_a_run(self, path: CameraPathKind, seed: int) -> None:
        """The same of all that a tracked camera has seen, where it was tracked: keyframes come often enough.

        The second camera draws back, and its first keyframe has all points for long.
        """
        source = SyntheticDataset(SyntheticConfig(width=320, height=240, frames=60, people=0, path=path, seed=seed))
        config = load_config("default", overrides=["semantics.model=null", "dense.enabled=true"])
        with Slam(source.camera, config) as slam:
            slam.run(source)
            cloud = slam.dense
        assert cloud is not None
        found = accuracy(cloud.points, source)
        assert found.mean_m < 0.015
        assert found.coverage > 0.9

    def test_colors(self) -> None:
        """Of a picture in one color, whatever its depth, every point has it."""
        source, frames = _room(people=0)
        red = replace(frames[0], rgb=np.full_like(frames[0].rgb, (200, 30, 10)))
        cloud = _made(source, [red]).cloud()
        assert len(cloud.points) > 5000
        np.testing.assert_array_equal(cloud.colors, np.broadcast_to((200, 30, 10), cloud.colors.shape))


class TestGhosts:
    def test_without_masks_and_carving_people_stay(self) -> None:
        """What the other tests would see if nothing were done."""
        source, frames = _room(people=2)
        assert _ghosts(_made(source, frames, replace(SMALL, carve=False)), source, frames) > 0.02

    @pytest.mark.parametrize("carve", [False, True])
    @pytest.mark.parametrize("late", [False, True])
    @pytest.mark.slow
    def test_masks(self, late: bool, carve: bool) -> None:
        source, frames = _room(people=2)
        dense = _made(source, frames, replace(SMALL, carve=carve), masks=True, late=late)
        assert _ghosts(dense, source, frames) < 0.005

    def test_walls_behind_people_are_none(self) -> None:
        """The same poses in the room without them: nothing is a ghost where they would have been."""
        source, frames = _room(people=2)
        empty, without = _room(people=0)
        assert _ghosts(_made(empty, without), source, frames) < 0.0005

    def test_carving(self) -> None:
        """Without any mask: what other keyframes see past is gone."""
        source, frames = _room(people=2)
        neither = _ghosts(_made(source, frames, replace(SMALL, carve=False)), source, frames)
        assert _ghosts(_made(source, frames), source, frames) < 0.5 * neither


class TestCorrections:
    def test_keyframes_that_move_take_their_points_along(self) -> None:
        """Put in at wrong poses and corrected, the map is that of the right ones."""
        source, frames = _room(people=0)
        config = replace(SMALL, carve=False)
        right = _made(source, frames[:4], config).cloud()
        rng = np.random.default_rng(0)
        wrong = [replace(f, T_world_cam=retract(f.T_world_cam, rng.normal(0, 0.1, 6))) for f in frames[:4]]
        dense = _made(source, wrong, config)
        assert np.mean(KDTree(right.points).query(dense.cloud().points)[0]) > 0.03
        dense.map_made(_map(source, [frame.T_world_cam for frame in frames[:4]]), -1, 0)
        dense.finish()
        cloud = dense.cloud()
        assert dense.figures().moved >= 4
        assert abs(len(cloud.points) - len(right.points)) <= 0.01 * len(right.points)
        distances = KDTree(right.points).query(cloud.points)[0]
        assert np.percentile(distances, 99) < 0.002

    def test_another_submap_is_not_shown(self) -> None:
        source, frames = _room(people=0)
        dense = _made(source, frames[:3])
        all_three = len(dense.cloud().points)
        slam_map = _map(source, [frame.T_world_cam for frame in frames[:3]])
        dense.map_made(slam_map._replace(submap=np.array([0, 1, 0], np.int32)), -1, 0)
        dense.finish()
        assert 0 < len(dense.cloud().points) < all_three


class TestBounds:
    @pytest.mark.slow
    def test_full_grid_gets_larger_voxels(self) -> None:
        source, frames = _room(people=0)
        dense = _made(source, frames, replace(SMALL, max_points=12_000))
        figures, cloud = dense.figures(), dense.cloud()
        assert figures.coarsened >= 1
        assert cloud.voxel_m == pytest.approx(0.02 * 2**figures.coarsened)
        assert 1000 < len(cloud.points) <= 12_000
        surface = true_surface(source, frames, people=False)
        assert np.mean(KDTree(surface[::2]).query(cloud.points)[0]) < 0.03

    def test_oldest_keyframes_are_forgotten(self) -> None:
        """Their points stay, and move no more; memory is what it may be."""
        source, frames = _room(people=0)
        dense = _made(source, frames, replace(SMALL, memory_mb=1.0, carve=False))
        whole = _made(source, frames, replace(SMALL, carve=False))
        assert dense.figures().frozen >= 5
        assert len(dense.cloud().points) == len(whole.cloud().points)
        assert dense.figures().working_mb < whole.figures().working_mb

    def test_looks_wait_too(self) -> None:
        """Looks of frames between keyframes stand before keyframes that are passed over."""
        source, frames = _room(people=0)
        dense = _mapping(source, deterministic=False)
        with dense._lock:
            _look(dense, frames[0])
            for index in range(12):
                _hand_over(dense, index, frames[0])
                dense.map_made(_map(source, [frames[0].T_world_cam] * (index + 1)), index, 0)
        dense.finish()
        dense.worker.close()
        assert dense.figures().passed_over >= 3

    def test_late_thread_passes_keyframes_over(self) -> None:
        source, frames = _room(people=0)
        dense = _mapping(source, deterministic=False)
        with dense._lock:  # it is held up
            for index in range(20):
                _hand_over(dense, index, frames[index % len(frames)])
                dense.map_made(_map(source, [frames[i % len(frames)].T_world_cam for i in range(index + 1)]), index, 0)
        dense.finish()
        dense.worker.close()
        figures = dense.figures()
        assert figures.passed_over >= 10
        assert figures.keyframes + figures.passed_over == 20

    def test_no_depth(self) -> None:
        source, frames = _room(people=0)
        blind = replace(frames[0], depth_m=np.full_like(frames[0].depth_m, np.nan))
        dense = _made(source, [blind])
        assert len(dense.cloud().points) == 0
        assert not dense.sees_anything
        assert picture(dense.cloud(), np.zeros((0, 7))).any()

    def test_nothing_yet(self) -> None:
        with pytest.raises(MapFileError, match="octree: expected at least one keyframe with depth"):
            _mapping(_room(people=0)[0]).cells()


def test_the_whole_path_is_in_the_picture() -> None:
    """Of a road, which is seen from 8 m ahead on only."""
    points = np.random.default_rng(0).uniform([-3, -1, 8], [3, 1, 60], (2000, 3)).astype(np.float32)
    gray, once = np.full((2000, 3), 90, np.uint8), np.ones(2000, np.int32)
    poses = np.tile(IDENTITY, (30, 1))
    poses[:, 6] = np.linspace(0, 40, 30)
    drawn = picture(DenseCloud(points, gray, once, np.zeros(2000, bool), 0.1), poses)
    is_path = (drawn == (255, 160, 0)).all(axis=2)
    for panel in np.split(is_path, 2, axis=1):
        rows, _ = np.nonzero(panel)
        assert np.ptp(rows) > 0.3 * len(panel)
        assert 5 < rows.min() < rows.max() < len(panel) - 5


@pytest.mark.slow
def test_key_objects_are_dense() -> None:
    """Inside the box of an object there are more points than voxels, also from a frame before the keyframe."""
    source, frames = _room(people=0)
    box = np.array([[120, 90, 200, 160]], np.float32)
    found = Detections(box, np.ones(1, np.float32), ("book",), None, None)
    dense = _mapping(source, replace(SMALL, key_window=EVERY), lambda image: found)
    dense.frame_tracked(0, frames[0].rgb, _arrays(frames[0]), _tracked_at(frames[0].T_world_cam))
    _hand_over(dense, 1, frames[1])
    dense.map_made(_map(source, [frame.T_world_cam for frame in frames[:2]]), 1, 0)
    dense.finish()
    cloud = dense.cloud()
    keys, others = cloud.points[cloud.is_key], cloud.points[~cloud.is_key]
    low, high = keys.min(axis=0), keys.max(axis=0)
    beside = ((others >= low) & (others <= high)).all(axis=1)
    assert len(keys) > 1.5 * beside.sum() > 100


class TestRun:
    @pytest.mark.slow
    def test_what_a_run_leaves(self, tmp_path: Path) -> None:
        recording = clip(frames=40)
        dense = DenseConfig(enabled=True, max_points=20_000, keyframe_points=4096, pixel_step=1)
        with Slam(recording.camera, Config(track=CONFIG.track, dense=dense)) as slam:
            records = slam.run(recording)
            summary, _ = write_results(tmp_path, slam, records, RunInfo(recording, "default", 1.0))
            cloud = slam.dense
        assert cloud is not None
        assert all((tmp_path / name).is_file() for name in DENSE_FILES)
        figures = json.loads((tmp_path / "summary.json").read_text())["dense"]
        assert figures == summary["dense"]
        assert figures["points"] == len(cloud.points) > 1000
        assert figures["keyframes"] == len(slam.map.ids)
        assert figures["ms_per_keyframe"]["median"] > 0
        assert {"reduce", "put in", "move"} <= set(figures["stage_ms"])
        header, body = (tmp_path / "map.ply").read_bytes().split(b"end_header\n", 1)
        assert f"element vertex {len(cloud.points)}".encode() in header
        assert len(body) == 19 * len(cloud.points)
        np.testing.assert_array_equal(np.frombuffer(body[:12], "<f4"), cloud.points[0])

    def test_off_by_default(self) -> None:
        with Slam(clip().camera, CONFIG) as slam:
            assert slam.dense is None
            assert slam.dense_mapping is None

    @pytest.mark.parametrize("bad", ["voxel_m=0", "pixel_step=0", "max_points=10", "memory_mb=-1", "color=true"])
    def test_settings_are_checked(self, bad: str) -> None:
        with pytest.raises(ConfigError, match=f"dense.{bad.partition('=')[0]}"):
            load_config(overrides=[f"dense.{bad}"])
