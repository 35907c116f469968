"""The synthetic recording as its users see it: configuration, repeatability, paths, actors, and how hard it is."""

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxslam.datasets.protocol import Dataset
from jaxslam.datasets.synthetic import SensorConfig, SyntheticConfig, SyntheticDataset, SyntheticFrame
from jaxslam.datasets.synthetic.cached_dataset import StoredRoom
from jaxslam.datasets.synthetic.camera_path import CAMERA_PATHS, LOOP_SECONDS, camera_path
from jaxslam.datasets.synthetic.homogeneous import inverse, matrix_from_pose
from jaxslam.datasets.synthetic.room import ROOM_HALF_M
from jaxslam.errors import ConfigError, DatasetError

SMALL = SyntheticConfig(width=160, height=120, frames=40, people=2, boxes=1)


@pytest.fixture(scope="module")
def small() -> SyntheticDataset:
    return SyntheticDataset(SMALL)


def fields_of(frame: SyntheticFrame) -> list[bytes]:
    return [np.asarray(value).tobytes() for value in vars(frame).values() if value is not None]


class TestProtocol:
    def test_is_a_dataset(self, small):
        dataset: Dataset = small
        assert len(dataset) == 40
        assert dataset.name == "synthetic_xyz_2people_1boxes_seed0"
        assert (dataset.camera.width, dataset.camera.height, dataset.camera.fps) == (160, 120, 30.0)
        assert dataset.ground_truth is not None
        np.testing.assert_array_equal(dataset.ground_truth.T_world_cam, small.T_world_cam)

    def test_frame_gives_nothing_away(self, small):
        frame, everything = small[3], small.render(3)
        assert frame.dynamic_mask is None
        assert frame.size == (160, 120)
        np.testing.assert_array_equal(frame.image, everything.rgb)
        np.testing.assert_array_equal(frame.depth_m, everything.depth_m)

    def test_arrays_are_as_documented(self, small):
        frame = small.render(0)
        expected = {
            "rgb": (np.uint8, (120, 160, 3)),
            "depth_m": (np.float32, (120, 160)),
            "exact_depth_m": (np.float32, (120, 160)),
            "instance_mask": (np.int32, (120, 160)),
            "T_world_cam": (np.float64, (7,)),
            "T_world_actor": (np.float64, (3, 7)),
        }
        for name, (dtype, shape) in expected.items():
            array = getattr(frame, name)
            assert (array.dtype, array.shape) == (dtype, shape), name
        assert type(frame.timestamp_ns) is int

    def test_intrinsics_scale_with_the_width(self, small):
        assert (small.fx, small.fy, small.cx, small.cy) == (131.25, 131.25, 79.5, 59.5)
        full = SyntheticDataset()
        assert (full.fx, full.fy, full.cx, full.cy) == (525.0, 525.0, 319.5, 239.5)

    def test_times_are_epoch_microseconds(self, small):
        steps = np.diff(small.timestamps_ns)
        assert small.timestamps_ns.dtype == np.int64
        assert small.timestamps_ns[0] > 10**18
        assert np.all(small.timestamps_ns % 1000 == 0)
        assert np.all(np.abs(steps - 1e9 / 30) <= 1000)

    def test_indices_are_those_of_a_sequence(self, small):
        assert small.render(-1).timestamp_ns == small.timestamps_ns[-1]
        for index in (40, -41):
            with pytest.raises(IndexError):
                small.render(index)


class TestConfig:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"path": "spiral"}, "SyntheticConfig.path: expected one of 'xyz'"),
            ({"people": -1}, "SyntheticConfig.people: expected an integer >= 0"),
            ({"frames": 0}, "SyntheticConfig.frames"),
            ({"width": 160.5}, "SyntheticConfig.width: expected an integer"),
            ({"fps": 0.0}, "SyntheticConfig.fps"),
        ],
    )
    def test_wrong_field_is_named(self, change, words):
        with pytest.raises(ConfigError, match=words):
            SyntheticConfig(**change)

    def test_even_exposure_is_refused(self):
        with pytest.raises(ConfigError, match=r"exposure_samples: expected an odd integer.*got 4"):
            SyntheticConfig(sensor=SensorConfig(exposure_samples=4))

    def test_unknown_path_suggests_one(self):
        with pytest.raises(ConfigError, match="did you mean 'halfsphere'"):
            camera_path("halfspere", np.zeros(1), 0)


class TestRepeatability:
    def test_same_bytes_in_any_order(self, small):
        forward = [fields_of(small.render(index)) for index in (0, 1, 20)]
        again = SyntheticDataset(SMALL)
        backward = [fields_of(again.render(index)) for index in (20, 1, 0)][::-1]
        assert forward == backward

    def test_same_bytes_where_float64_is_enabled(self, small):
        with jax.enable_x64(True):
            frame = SyntheticDataset(SMALL).render(1)
        assert fields_of(frame) == fields_of(small.render(1))

    def test_frame_does_not_depend_on_their_number(self, small):
        longer = SyntheticDataset(dataclasses.replace(SMALL, frames=400))
        assert fields_of(longer.render(7)) == fields_of(small.render(7))

    def test_stored_frames_are_the_same(self, small, tmp_path, monkeypatch):
        fields = [fields_of(small.render(index)) for index in range(4)]
        config = dataclasses.replace(SMALL, frames=4)
        StoredRoom(config, tmp_path / "a" / "room").render_all()
        # From here on nothing is rendered.
        monkeypatch.setattr(SyntheticDataset, "render", None)
        stored = StoredRoom(config, tmp_path / "a" / "room")
        assert [fields_of(stored.render(index)) for index in (0, 1, 2, -1)] == fields
        assert stored[1].timestamp_ns == small.timestamps_ns[1]
        with pytest.raises(IndexError):
            stored.render(4)

    @pytest.mark.slow
    def test_stored_pairs(self, tmp_path):
        config = dataclasses.replace(SMALL, frames=1, baseline_m=0.1)
        rendered, stored = (StoredRoom(config, tmp_path / "room").render(0) for _ in range(2))
        assert stored.right is not None
        assert fields_of(stored) == fields_of(rendered)

    def test_frames_that_cannot_be_stored(self, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(DatasetError, match="file/room: cannot be made: Not a directory"):
            StoredRoom(dataclasses.replace(SMALL, frames=1), tmp_path / "file" / "room").render_all()

    def test_seed_changes_everything(self, small):
        other = SyntheticDataset(dataclasses.replace(SMALL, seed=1)).render(0)
        one = small.render(0)
        for name in ("rgb", "depth_m", "instance_mask", "T_world_cam", "T_world_actor"):
            assert not np.array_equal(getattr(one, name), getattr(other, name)), name

    @pytest.fixture
    def all_compiles_logged(self):
        """Log compiles in all threads, as `jax.log_compiles` does not: views are rendered in others."""
        jax.config.update("jax_log_compiles", True)
        yield
        jax.config.update("jax_log_compiles", False)

    @pytest.mark.usefixtures("all_compiles_logged")
    def test_single_trace(self, small, caplog):
        small.render(0)
        caplog.clear()
        with caplog.at_level("WARNING"):
            SyntheticDataset(dataclasses.replace(SMALL, people=4, boxes=2, path="loop", fps=15.0, seed=5)).render(3)
            assert not [record.getMessage() for record in caplog.records if "render" in record.getMessage()]
            SyntheticDataset(dataclasses.replace(SMALL, people=5)).render(3)
            assert [record.getMessage() for record in caplog.records if "render" in record.getMessage()]


@pytest.mark.parametrize("kind", CAMERA_PATHS)
class TestCameraPath:
    RATE = 100.0

    def poses(self, kind: str, seed: int) -> np.ndarray:
        return camera_path(kind, np.arange(0.0, 40.0, 1.0 / self.RATE), seed)

    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_stays_in_the_room_at_the_pace_of_a_hand(self, kind, seed):
        poses = self.poses(kind, seed)
        assert np.all(np.abs(poses[:, 4:6]) < np.array(ROOM_HALF_M[:2]) - 0.4)
        assert np.all((poses[:, 6] > 0.8) & (poses[:, 6] < 2.2))
        matrices = matrix_from_pose(poses)
        speed = np.linalg.norm(np.diff(poses[:, 4:], axis=0), axis=1) * self.RATE
        relative = inverse(matrices[:-1]) @ matrices[1:]
        cosine = 0.5 * (np.trace(relative[:, :3, :3], axis1=1, axis2=2) - 1.0)
        turn = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))) * self.RATE
        assert speed.max() < 0.5
        assert turn.max() < 60.0
        assert (speed.mean() > 0.1) == (kind in ("xyz", "halfsphere", "loop"))
        assert (turn.max() > 35.0) == (kind == "rpy")
        acceleration = np.linalg.norm(np.diff(poses[:, 4:], 2, axis=0), axis=1) * self.RATE**2
        assert acceleration.max() < 2.0

    def test_is_a_rotation_that_keeps_upright(self, kind):
        poses = self.poses(kind, 0)
        np.testing.assert_allclose(np.linalg.norm(poses[:, :4], axis=1), 1.0, atol=1e-12)
        matrices = matrix_from_pose(poses)
        assert np.all(matrices[:, 2, 1] < -0.6)
        theirs = jaxlie.SE3(jnp.asarray(poses[17], jnp.float32)).as_matrix()
        np.testing.assert_allclose(matrices[17], theirs, atol=1e-6)

    def test_sees_what_is_near(self, kind):
        config = dataclasses.replace(SMALL, path=kind, people=0, boxes=0, frames=960)
        dataset = SyntheticDataset(config)
        for index in (0, 170, 333, 480, 700):
            depth = dataset.render(index).exact_depth_m
            assert 0.5 < np.median(depth) < 4.8
            assert depth.min() > 0.3


def test_loop_closes():
    start, end = camera_path("loop", np.array([0.0, LOOP_SECONDS]), 3)
    assert np.linalg.norm(end[4:] - start[4:]) < 0.02
    assert abs(np.dot(end[:4], start[:4])) > np.cos(np.deg2rad(1.0))


class TestActors:
    TIME = np.arange(0.0, 30.0, 0.02)

    @pytest.mark.parametrize("path", CAMERA_PATHS)
    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_walk_in_the_room_and_out_of_the_cameras_way(self, path, seed):
        dataset = SyntheticDataset(dataclasses.replace(SMALL, path=path, people=3, seed=seed))
        poses = dataset.T_world_actor(self.TIME)
        assert poses.shape == (len(self.TIME), 4, 7)
        assert np.all(np.abs(poses[..., 4:6]) < np.array(ROOM_HALF_M[:2]) - 0.3)
        speed = np.linalg.norm(np.diff(poses[..., 4:], axis=0), axis=-1) / 0.02
        assert speed.max() < 1.3
        assert np.all(speed.mean(axis=0) > 0.2)
        camera = camera_path(path, self.TIME, seed)[:, None, 4:6]
        assert np.linalg.norm(poses[..., 4:6] - camera, axis=-1).min() > 0.5
        apart = np.linalg.norm(poses[:, :, None, 4:6] - poses[:, None, :, 4:6], axis=-1) + np.eye(4)
        assert apart.min() > 0.25

    def test_legs_and_arms_swing(self, small):
        parts = small.actors[0].parts(self.TIME)
        travel = np.ptp(parts[:, :, :3, 3], axis=0)
        assert np.all(travel[:5] < 0.05)  # the trunk
        assert np.all(travel[[6, 7, 11, 12], 0] > 0.3)  # shins and feet
        assert np.all(travel[[9, 14], 0] > 0.15)  # forearms
        feet = parts[:, [7, 12], 2, 3]
        assert feet.min() > 0.0
        assert feet.min(axis=1).max() < 0.15  # one is always near the floor

    def test_fill_much_of_the_picture_but_not_all(self):
        dataset = SyntheticDataset(dataclasses.replace(SMALL, people=3, boxes=0, frames=300))
        share = [np.mean(dataset.render(index).instance_mask > 0) for index in range(0, 300, 12)]
        assert max(share) > 0.4
        assert np.mean(share) > 0.25
        assert max(share) < 0.75

    def test_none(self):
        frame = SyntheticDataset(dataclasses.replace(SMALL, people=0, boxes=0)).render(0)
        assert frame.T_world_actor.shape == (0, 7)
        assert not frame.instance_mask.any()


class TestHardness:
    """What the scene is for: it defeats an odometry that believes everything it tracks."""

    @staticmethod
    def lift(dataset: SyntheticDataset, depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        column, row = np.round(pixels).astype(int).T
        x, y = (pixels[:, 0] - dataset.cx) / dataset.fx, (pixels[:, 1] - dataset.cy) / dataset.fy
        return depth[row, column, None] * np.stack([x, y, np.ones_like(x)], axis=1)

    @staticmethod
    def align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Least squares over all matches (Kabsch 1976)."""
        u, _, vt = np.linalg.svd((source - source.mean(0)).T @ (target - target.mean(0)))
        rotation = (vt.T * [1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = rotation, target.mean(0) - rotation @ source.mean(0)
        return motion

    def error(self, people: int) -> float:
        config = SyntheticConfig(width=320, height=240, frames=90, people=people)
        dataset = SyntheticDataset(config)
        truth = matrix_from_pose(dataset.T_world_cam)
        pose, frame, errors = truth[0], dataset[0], []
        for index in range(1, len(dataset)):
            last, frame = frame, dataset[index]
            gray, last_gray = (cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY) for f in (frame, last))
            corners = cv2.goodFeaturesToTrack(last_gray, 400, 0.01, 6)
            moved, found, _ = cv2.calcOpticalFlowPyrLK(last_gray, gray, corners, corners.copy(), winSize=(15, 15))
            start, end = corners[:, 0], moved[:, 0]
            inside = np.all((end >= 0) & (end <= [dataset.width - 1, dataset.height - 1]), axis=1)
            kept = (found[:, 0] == 1) & inside
            assert last.depth_m is not None
            assert frame.depth_m is not None
            before = self.lift(dataset, last.depth_m, start[kept])
            after = self.lift(dataset, frame.depth_m, end[kept])
            measured = (before[:, 2] > 0) & (after[:, 2] > 0)
            pose = pose @ self.align(after[measured], before[measured])
            errors.append(np.linalg.norm(pose[:3, 3] - truth[index, :3, 3]))
        return float(np.sqrt(np.mean(np.square(errors))))

    @pytest.mark.slow
    def test_odometry_without_rejection_fails_only_where_people_walk(self):
        calm, crowded = self.error(people=0), self.error(people=2)
        assert calm < 0.06
        assert crowded > 0.3
        assert crowded > 5.0 * calm

    @pytest.mark.parametrize("path", CAMERA_PATHS)
    def test_corners_everywhere(self, path):
        image = SyntheticDataset(SyntheticConfig(path=path, people=0)).render(60).rgb
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(gray, 2000, 0.01, 7)[:, 0]
        assert len(corners) > 500
        cell, _, _ = np.histogram2d(corners[:, 0], corners[:, 1], bins=(4, 3), range=((0, 640), (0, 480)))
        assert np.count_nonzero(cell >= 5) >= 10
