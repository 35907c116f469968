"""Losses and what comes after: the same world again, the policies, and a map kept in a file."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import failing, printed_json
from replay import BLACK, CONFIG, HOLD, PREDICT, SUBMAP, Order, Played
from room_round import FPS, FRAMES, TRACK, room
from small_map import same

from jaxslam.cli.entry_point import main
from jaxslam.config.schema import Config, RunConfig, TrackConfig
from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic import SyntheticDataset, write_tum
from jaxslam.geometry.se3 import IDENTITY, angle, between, retract
from jaxslam.map.npz_file import load_map, save_map
from jaxslam.map.types import empty_map
from jaxslam.map.validate import problems
from jaxslam.sensors.camera import Camera
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackReason, TrackStatus
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import read as read_trajectory

HERE = Path(__file__).resolve()
FOLDERS = f"{HERE.parents[2] / 'helpers'},{HERE.parent}"

fails = failing()


def play(order: Order, config: Config = CONFIG, gap_s: float = 0.0) -> Played:
    with Slam(room().camera, config) as slam:
        return Played(slam, room(), order, FPS, gap_s)


BEFORE, AFTER = list(range(60)), list(range(15, 50))


class TestKidnap:
    @pytest.mark.parametrize(
        "config",
        [
            pytest.param(HOLD, id="hold"),
            pytest.param(PREDICT, marks=pytest.mark.slow, id="predict"),
            pytest.param(SUBMAP, marks=pytest.mark.slow, id="submap"),
        ],
    )
    def test_black_frames(self, config: Config) -> None:
        """Sixty black frames, then a place seen before: the same world within 15 frames, and right in it."""
        played = play([*BEFORE, *[BLACK] * 60, *AFTER], config)
        assert set(played.statuses[1:60]) == {TrackStatus.OK}
        assert set(played.statuses[60:120]) == {TrackStatus.LOST}
        found = played.first(TrackStatus.RELOCALIZED)
        assert found < 120 + 15
        assert set(played.statuses[found + 1 :]) == {TrackStatus.OK}
        errors = played.errors_m(range(found, len(played.order)))
        print(f"recognized after {found - 119} frames; largest error after it {errors.max() * 1e3:.1f} mm")
        assert errors.max() < 0.03
        assert np.unique(played.slam.map.submap).tolist() == [0]

    @pytest.mark.slow
    def test_cut(self) -> None:
        """A jump in time and place without any black frame."""
        played = play([*BEFORE, *AFTER], gap_s=2.0)
        found = played.first(TrackStatus.RELOCALIZED)
        assert 60 <= found < 60 + 15
        errors = played.errors_m(range(found, len(played.order)))
        print(f"recognized after {found - 59} frames; largest error after it {errors.max() * 1e3:.1f} mm")
        assert errors.max() < 0.03
        assert 0 < np.sqrt(np.diag(played.results[found].covariance)).max() < 0.03

    def test_without_depth(self) -> None:
        """With nothing to follow and no depth to begin with, the map still shows where the frame was taken."""
        frames = room()
        frames.frames[41] = replace(frames[41], depth_m=np.zeros_like(frames[41].depth_m))
        with Slam(frames.camera, CONFIG) as slam:
            before = Played(slam, frames, range(41), FPS)
            slam._tracker.state = slam._back.start_submap(slam._tracker.state, before.results[-1].T_world_cam)
            slam._back.localizer._last = None  # nor has the frame before anything in common with it
            after = Played(slam, frames, range(41, 46), FPS)
        assert after.statuses == [*[TrackStatus.RELOCALIZED] * 2, *[TrackStatus.OK] * 3]
        found = after.results[0]
        assert found.reason == TrackReason.NO_DEPTH.text  # why flow had lost it
        assert found.num_matched >= 30
        assert np.sqrt(np.diag(found.covariance)).max() < 0.03
        true = [between(before.truth.T_world_cam[0], pose) for pose in after.truth.T_world_cam]
        apart = [
            np.linalg.norm(result.T_world_cam[4:] - pose[4:]) for result, pose in zip(after.results, true, strict=True)
        ]
        assert max(apart) < 0.03

    @pytest.mark.slow
    def test_keyframes_are_at_hand_at_once(self) -> None:
        """Those that show the place are reloaded with the relocalization: their points are found again."""
        played = play([*BEFORE, *[BLACK] * 3, *AFTER])
        found = played.first(TrackStatus.RELOCALIZED)
        assert played.results[found + 1].num_keyframe_matches > 60

    @pytest.mark.slow
    def test_real(self, data_dir: Path) -> None:
        """The first frame has a rolling shutter and no motion yet to correct it by: 14 to 38 mm in 24 runs."""
        dataset = open_dataset(data_dir / "tum/rgbd_dataset_freiburg1_rpy_excerpt")
        first, largest = list[float](), list[float]()
        for seed, black, gap_s in ((0, 60, 0.0), (1, 0, 2.0), (2, 0, 2.0)):
            with Slam(dataset.camera, Config(run=RunConfig(seed=seed))) as slam:
                order = [*range(100), *[BLACK] * black, *range(30, 90)]
                played = Played(slam, dataset, order, dataset.camera.fps, gap_s)
            found = played.first(TrackStatus.RELOCALIZED)
            assert 100 + black <= found < 115 + black
            errors = played.aligned_errors_m(range(100), range(found, len(order)))
            first.append(errors[0])
            largest.append(errors[1:].max())
            ate = evaluate(slam.trajectory, played.truth).ate_rmse_m
            print(f"{black} black: recognized in {found - 99 - black} frames, {1e3 * errors[0]:.1f} mm off there,")
            print(f"then up to {1e3 * errors[1:].max():.1f} mm, ATE of all {ate * 1e3:.1f} mm")
            assert ate < 0.0215
        assert np.median(first) < 0.03
        assert np.median(largest) < 0.03


class TestPolicies:
    def test_hold(self) -> None:
        """The last pose, however long, and no new submap at a place never seen."""
        played = play([*range(120, 150), *[BLACK] * 5, *range(30)], HOLD)
        assert set(played.statuses[30:]) == {TrackStatus.LOST}
        held = np.array([result.T_world_cam for result in played.results[30:]])
        # What mapping still had to correct moves the pose held, too; then it stays.
        settled = 30 + HOLD.mapping.latency_frames
        np.testing.assert_array_equal(held[settled - 30 :], np.broadcast_to(held[-1], held[settled - 30 :].shape))
        assert np.linalg.norm(held[-1, 4:] - played.results[29].T_world_cam[4:]) < 0.02
        assert played.slam.map.submap.max() == 0
        assert len(played.slam.trajectory) == 30

    def test_predict(self) -> None:
        """Constant velocity for a second, and that pose from then on."""
        played = play([*range(40), *[BLACK] * 30], PREDICT)
        last = played.results[39]
        for number, result in enumerate(played.results[40:], 1):
            expected = retract(last.T_world_cam, last.twist * min(number / FPS, 1.0))
            apart = between(expected, result.T_world_cam)
            assert np.linalg.norm(apart[4:]) < 1e-6
            assert angle(apart) < 1e-6
        assert np.linalg.norm(played.results[-1].T_world_cam[4:] - last.T_world_cam[4:]) > 0.05

    @pytest.mark.slow
    def test_submap_becomes_one_with_the_first(self) -> None:
        """A place A, a loss, a place B never seen, and on to A: all poses are in the world of A in the end."""
        order = [*range(110, 140), *[BLACK] * 20, *range(FRAMES)]
        played = play(order, SUBMAP)
        started = played.first(TrackStatus.STARTED, 1)
        assert 50 + TRACK.restart_after <= started <= 50 + TRACK.restart_after + 10
        assert set(played.statuses[30:started]) == {TrackStatus.LOST}
        assert set(played.statuses[started + 1 :]) <= {TrackStatus.OK, TrackStatus.WEAK}
        slam = played.slam
        assert slam.loops_closed >= 1
        assert slam.map.submap.tolist() == [0] * len(slam.map.ids)
        # The world is still that of A: where the camera was at first.
        np.testing.assert_allclose(slam.map.pose(0), IDENTITY, atol=1e-9)
        trajectory = slam.trajectory
        assert len(trajectory) == 30 + len(order) - started
        true = played.truth.at(trajectory.timestamps_ns).T_world_cam
        apart = trajectory.T_world_cam[:, 4:] - between(true[:1], true)[:, 4:]
        errors = np.linalg.norm(apart, axis=1)
        jump = max(np.linalg.norm(result.correction[4:]) for result in played.results[started:])
        print(f"begun after {started - 49} frames, merged by {jump:.2f} m; errors up to {errors.max() * 1e3:.1f} mm")
        assert jump > 0.3  # where B was begun is far from where it is
        assert errors.max() < 0.05
        assert problems(slam.map) == []

    @pytest.mark.slow
    def test_localizing_begins_no_submap(self) -> None:
        """A place that is not in the map stays unknown, whatever the policy."""
        start = play(range(120, 140)).slam.map
        with Slam(room().camera, SUBMAP, slam_map=start, localize_only=True) as slam:
            played = Played(slam, room(), [*range(120, 130), *range(40)], FPS, 2.0)
        assert played.statuses[0] is TrackStatus.RELOCALIZED
        assert TrackStatus.STARTED not in played.statuses
        assert same(slam.map, start)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Slam, Path]:
    """A tracker that has mapped sixty frames, and the file of its map."""
    path = tmp_path_factory.mktemp("map") / "room.npz"
    slam = play(BEFORE).slam
    slam.save(path)
    return slam, path


def localize(path: Path, out: Path) -> None:
    """Localize the same frames with a map from a file, and write poses, statuses and the map."""
    slam = Slam.load(path, config=CONFIG, localize_only=True)
    played = Played(slam, room(), BEFORE, FPS)
    np.save(out / "poses.npy", np.array([result.T_world_cam for result in played.results]))
    np.save(out / "statuses.npy", np.array(played.statuses))
    save_map(out / "again.npz", slam.map)


class TestFile:
    @pytest.mark.slow
    def test_localize_in_another_process(self, mapped: tuple[Slam, Path], tmp_path: Path) -> None:
        """The poses of a run in memory, and a map that is the same to the bit."""
        slam, path = mapped
        assert same(load_map(path), slam.map)
        script = (
            "import sys; sys.path[:0] = sys.argv[1].split(',')\n"
            "import jax; jax.config.update('jax_numpy_dtype_promotion', 'strict')\n"
            "jax.config.update('jax_numpy_rank_promotion', 'raise')\n"
            "from pathlib import Path; import test_relocalization\n"
            "test_relocalization.localize(Path(sys.argv[2]), Path(sys.argv[3]))\n"
        )
        subprocess.run([sys.executable, "-c", script, FOLDERS, str(path), str(tmp_path)], check=True, timeout=300)
        here = Slam(room().camera, CONFIG, slam_map=slam.map, localize_only=True)
        played = Played(here, room(), BEFORE, FPS)
        poses = np.array([result.T_world_cam for result in played.results])
        np.testing.assert_allclose(np.load(tmp_path / "poses.npy"), poses, rtol=0, atol=1e-6)
        assert np.load(tmp_path / "statuses.npy").tolist() == played.statuses
        assert played.statuses[0] is TrackStatus.RELOCALIZED
        assert set(played.statuses[1:]) == {TrackStatus.OK}
        assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()
        assert here.map is slam.map
        errors = played.errors_m(range(len(BEFORE)))
        print(f"localized to {errors.max() * 1e3:.1f} mm at most, mean {errors.mean() * 1e3:.1f}")
        assert errors.max() < 0.03

    def test_second_clip_goes_on(self, mapped: tuple[Slam, Path]) -> None:
        """Its keyframes are added to those of the file, in their world."""
        before = load_map(mapped[1])
        with Slam.load(mapped[1], config=CONFIG) as slam:
            played = Played(slam, room(), range(30, 110), FPS)
        assert played.statuses[0] is TrackStatus.RELOCALIZED
        assert slam.map.next_keyframe > before.next_keyframe
        assert np.unique(slam.map.submap).tolist() == [0]
        assert slam.map.parent[slam.map.row(before.next_keyframe)] < before.next_keyframe
        assert problems(slam.map) == []
        start = room().source.ground_truth.T_world_cam[0]
        there = np.array([result.T_world_cam for result in played.results])
        errors = np.linalg.norm(there[:, 4:] - between(start[None], played.truth.T_world_cam)[:, 4:], axis=1)
        print(f"second clip: errors up to {errors.max() * 1e3:.1f} mm")
        assert errors.max() < 0.05

    def test_reset_begins_with_the_map_again(self, mapped: tuple[Slam, Path]) -> None:
        with Slam.load(mapped[1], config=CONFIG) as slam:
            start = slam.map
            Played(slam, room(), range(40, 60), FPS)
            slam.reset()
            assert slam.map is start
            assert slam.track(room()[20]).status is TrackStatus.RELOCALIZED


SETTINGS = [
    f"track.{name}={getattr(TRACK, name)}"
    for name in TrackConfig.__dataclass_fields__
    if getattr(TRACK, name) != getattr(TrackConfig(), name)
]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames as a recording in files."""
    folder = tmp_path_factory.mktemp("recordings") / "room"
    write_tum(SyntheticDataset(replace(room().source.config, frames=40)), folder)
    return folder


class TestCommandLine:
    @pytest.mark.slow
    def test_run_localize_export(self, written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        map_file, settings = tmp_path / "m.npz", ["--set", *SETTINGS]
        main(["run", str(written), "--save-map", str(map_file), "--out", str(tmp_path / "one"), *settings])
        assert f"Map in {map_file}" in capsys.readouterr().out
        before = map_file.read_bytes()
        out = tmp_path / "two"
        main(["run", str(written), "--map", str(map_file), "--localize-only", "--out", str(out), "--json", *settings])
        summary, messages = printed_json(capsys)
        assert summary == json.loads((out / "summary.json").read_text())
        assert summary["status_counts"]["RELOCALIZED"] == 1
        assert "Tracking" in messages
        assert map_file.read_bytes() == before
        one, two = (read_trajectory(tmp_path / name / "trajectory.txt") for name in ("one", "two"))
        assert len(one) == len(two) == 40
        assert np.linalg.norm(one.T_world_cam[:, 4:] - two.T_world_cam[:, 4:], axis=1).max() < 0.03
        names = {"--ply": "m.ply", "--colmap": "model", "--trajectory": "k.txt"}
        chosen = [part for option, name in names.items() for part in (option, str(tmp_path / name))]
        main(["export", str(map_file), *chosen, "--json"])
        figures, _ = printed_json(capsys)
        assert figures["keyframes"] == len(read_trajectory(tmp_path / "k.txt")) == len(load_map(map_file).ids)
        assert figures["files"] == [str(tmp_path / name) for name in names.values()]
        assert (tmp_path / "m.ply").read_bytes().startswith(b"ply")
        assert any(tmp_path.joinpath("model").rglob("cameras.txt"))

    def test_wrong_uses(self, written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        damaged, other = tmp_path / "damaged.npz", tmp_path / "other.npz"
        start = play(range(2)).slam.map
        save_map(damaged, start)
        damaged.write_bytes(damaged.read_bytes()[:-200])
        save_map(other, empty_map(Camera("other", 64, 48, 50.0, 50.0, 31.5, 23.5)))
        missing = str(tmp_path / "missing.npz")
        for arguments, expected in (
            (["--map", str(damaged)], "damaged.npz"),
            (["--map", missing], "missing.npz"),
            (["--map", str(other)], "expected one of a camera of 320x240 pixels, got 64x48"),
            (["--localize-only"], "--localize-only: needs the map to localize in: --map FILE"),
        ):
            assert expected in fails(capsys, "run", str(written), *arguments)
        assert "damaged.npz" in fails(capsys, "export", str(damaged), "--ply", str(tmp_path / "x.ply"))
        save_map(damaged, start)
        assert "expected at least one of --ply" in fails(capsys, "export", str(damaged))
