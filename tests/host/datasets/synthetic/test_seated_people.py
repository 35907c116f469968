"""People who sit in the synthetic room: how they move, that they are seen, and that nothing else changes."""

import dataclasses
import zlib

import numpy as np
import pytest

from jaxslam.datasets.synthetic import PERFECT_SENSOR, SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.errors import ConfigError

SMALL = SyntheticConfig(width=160, height=120, frames=120, people=0, seated=2)
ONE_RAY = dataclasses.replace(PERFECT_SENSOR, exposure_samples=1)
"""A pixel is what its center sees at one moment, so that it changes only where that does."""
PATHS: list[CameraPathKind] = ["xyz", "rpy", "halfsphere", "static"]
HEAD, FOREARMS, LEGS = [3, 4], [9, 14], [5, 6, 7, 10, 11, 12]
FACE_M = 0.095
STEP_S = 0.01


def joints(dataset: SyntheticDataset, actor: int) -> np.ndarray:
    """Both ends of the axes of an actor's solids over half a minute: `(t, 15, 2, 3)` meters."""
    one = dataset.actors[actor]
    parts = one.parts(np.arange(0.0, 30.0, STEP_S))
    half = np.array([solid.size[2] * (solid.stem or 0.0) for solid in one.solids])
    ends = np.array([-1.0, 1.0])[:, None] * half[:, None, None] * parts[:, :, None, :3, 2]
    return parts[:, :, None, :3, 3] + ends


def speeds(points: np.ndarray) -> np.ndarray:
    """`(t - 1, ...)` meters a second of `(t, ..., 3)` points."""
    return np.linalg.norm(np.diff(points, axis=0), axis=-1) / STEP_S


class TestMotion:
    @pytest.mark.parametrize("seed", [0, 1, 2, 2**31 - 1])
    @pytest.mark.parametrize("actor", [0, 1])
    def test_of_a_few_centimeters(self, seed: int, actor: int) -> None:
        dataset = SyntheticDataset(dataclasses.replace(SMALL, seed=seed))
        places, speed = joints(dataset, actor), speeds(joints(dataset, actor))
        others = [part for part in range(15) if part not in FOREARMS]
        assert speed[:, others].max() < 0.15
        assert speed[:, FOREARMS].max() < 0.4
        assert np.mean(speed < 0.15) > 0.95
        head = np.ptp(places[:, HEAD, 0], axis=0)
        assert np.all((head[:, :2] > 0.02) & (head[:, :2] < 0.10))
        assert np.ptp(places[:, LEGS], axis=0).max() == 0.0

    @pytest.mark.parametrize("actor", [0, 1])
    def test_one_hand_is_raised_now_and_then(self, actor: int) -> None:
        height = joints(SyntheticDataset(SMALL), actor)[:, FOREARMS].max(axis=2)[..., 2]
        raised = np.ptp(height, axis=0)
        assert raised.max() > 0.2
        assert raised.min() < 0.03
        up = height[:, raised.argmax()] > height[:, raised.argmax()].min() + 0.5 * raised.max()
        assert 0.1 < up.mean() < 0.4
        assert 4 <= np.count_nonzero(np.diff(up.astype(int)) == 1) <= 8

    def test_head_turns(self) -> None:
        dataset = SyntheticDataset(SMALL)
        time_s = np.arange(0.0, 30.0, STEP_S)
        for actor in dataset.actors:
            ahead = actor.parts(time_s)[:, HEAD[0], :3, 0]
            yaw = np.rad2deg(np.arctan2(ahead[:, 1], ahead[:, 0]))
            assert 40.0 < np.ptp(yaw) < 70.0
            face = actor.parts(time_s)[:, HEAD[0], :3, 3] + FACE_M * ahead
            assert speeds(face).max() < 0.15

    def test_sits_on_the_chair_with_feet_near_the_floor(self) -> None:
        for seed in range(4):
            for actor in SyntheticDataset(dataclasses.replace(SMALL, seed=seed)).actors:
                parts = actor.parts(np.zeros(1))[0, :, 2, 3]
                thigh = parts[5] - actor.solids[5].size[2]
                sole = parts[7] - actor.solids[7].size[2]
                assert 0.40 < thigh < 0.47
                assert 0.0 < sole < 0.07

    def test_root_rests_at_the_ends_of_the_desk(self) -> None:
        poses = SyntheticDataset(SMALL).T_world_actor(np.linspace(0.0, 30.0, 50))
        assert np.ptp(poses, axis=0).max() == 0.0
        np.testing.assert_array_equal(np.sign(poses[0, :, 5]), [1.0, -1.0])
        assert np.all(np.abs(poses[0, :, 5]) > 0.83 + 0.2)  # the desk and a trunk


class TestPictures:
    @pytest.mark.parametrize("path", PATHS)
    @pytest.mark.parametrize("seed", [0, 1])
    def test_are_seen(self, path: CameraPathKind, seed: int) -> None:
        """One of them always, and both most of the time, also where the camera turns."""
        dataset = SyntheticDataset(dataclasses.replace(SMALL, path=path, seed=seed))
        masks = [dataset.render(index).instance_mask for index in range(0, 120, 6)]
        share = np.array([[np.mean(mask == number) for number in (1, 2)] for mask in masks])
        assert share.sum(axis=1).min() > 0.01
        assert np.all(np.mean(share > 0.005, axis=0) > 0.5)
        assert share.sum(axis=1).max() < 0.2

    def test_chairs_are_static_and_come_with_them(self) -> None:
        config = dataclasses.replace(SMALL, path="static", sensor=ONE_RAY)
        empty = SyntheticDataset(dataclasses.replace(config, seated=0))
        chairs = []
        for index in (0, 40, 80):
            room, frame = empty.render(index), SyntheticDataset(config).render(index)
            nearer = frame.exact_depth_m < room.exact_depth_m
            assert np.all(nearer[frame.instance_mask > 0])
            np.testing.assert_array_equal(frame.exact_depth_m[~nearer], room.exact_depth_m[~nearer])
            np.testing.assert_array_equal(frame.rgb[~nearer], room.rgb[~nearer])
            chairs.append(np.mean(nearer & (frame.instance_mask == 0)))
        assert min(chairs) > 0.005

    def test_others_stay_as_they_are(self) -> None:
        """Those who walk, and boxes, keep their numbers, clothes and ways."""
        config = dataclasses.replace(SMALL, people=2, boxes=1, sensor=ONE_RAY)
        alone = SyntheticDataset(dataclasses.replace(config, seated=0))
        crowded = SyntheticDataset(config)
        for index in (0, 60):
            one, other = alone.render(index), crowded.render(index)
            np.testing.assert_array_equal(other.T_world_actor[:3], one.T_world_actor)
            np.testing.assert_array_equal(other.T_world_cam, one.T_world_cam)
            changed = other.exact_depth_m != one.exact_depth_m
            np.testing.assert_array_equal(other.instance_mask[~changed], one.instance_mask[~changed])
            assert set(np.unique(other.instance_mask[changed])) == {0, 4, 5}
            assert changed.mean() < 0.2
            np.testing.assert_array_equal(other.rgb[~changed], one.rgb[~changed])

    def test_repeat(self) -> None:
        first, second = (SyntheticDataset(SMALL).render(31) for _ in range(2))
        np.testing.assert_array_equal(first.rgb, second.rgb)
        np.testing.assert_array_equal(first.instance_mask, second.instance_mask)


class TestRoomWithoutThem:
    """What was rendered before people could sit is rendered still: all that frames are made of, in whole numbers."""

    @pytest.mark.parametrize(
        ("seed", "people", "boxes", "surfaces", "sizes"),
        [(0, 2, 0, 2718662173, 954979279), (0, 2, 1, 1091736391, 293057176), (5, 3, 3, 1808493537, 240270907)],
    )
    def test_solids(self, seed: int, people: int, boxes: int, surfaces: int, sizes: int) -> None:
        room = SyntheticDataset(SyntheticConfig(seed=seed, people=people, boxes=boxes, width=64, height=48, frames=1))
        scene, _ = room._stage.whole
        micrometers = [np.round(1e6 * np.asarray(part, np.float64)).astype(np.int64) for part in scene[:2]]
        assert zlib.crc32(np.asarray(scene.surface).tobytes()) == surfaces
        assert zlib.crc32(b"".join(part.tobytes() for part in micrometers)) == sizes

    def test_ways(self) -> None:
        room = SyntheticDataset(SyntheticConfig(people=2, boxes=1, width=64, height=48, frames=1))
        expected = [
            [-0.992314082971, 0.269123380954, 0.0],
            [-0.43156218409, 0.728293827839, 0.0],
            [1.271003203055, -0.839822661249, 1.267404968407],
        ]
        np.testing.assert_allclose(room.T_world_actor(np.array([1.7]))[0, :, 4:], expected, rtol=0.0, atol=1e-11)

    def test_name(self) -> None:
        assert SyntheticDataset(SyntheticConfig(frames=1)).name == "synthetic_xyz_2people_0boxes_seed0"
        assert SyntheticDataset(SMALL).name == "synthetic_xyz_0people_0boxes_2seated_seed0"


def test_no_more_than_there_are_chairs() -> None:
    with pytest.raises(ConfigError, match=r"SyntheticConfig.seated: expected an integer .*, got 3"):
        SyntheticConfig(seated=3)
