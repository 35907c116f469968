"""Ways of the camera: through points, and from files."""

import dataclasses

import numpy as np
import pytest

from jaxslam.errors import ConfigError, TrajectoryError
from jaxslam.geometry.se3 import angle, between, compose, inverse
from jaxslam.geometry.so3 import matrices
from jaxslam.trajectory import trajectory
from jaxslam.trajectory.trajectory import Trajectory
from jaxslam.worlds import World, WorldRecording, load_world
from jaxslam.worlds.camera_way import camera_way
from jaxslam.worlds.description import Way

POINTS = Way(((0.0, 0.0, 1.4), (2.0, 0.0, 1.4), (2.0, 2.0, 1.8)), speed_m_per_s=0.5, ends="loop")
WORLD = World("A way.", 4.0, POINTS)


def optical_axis(poses: np.ndarray) -> np.ndarray:
    w, x, y, z = poses[:, :4].T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def saved(folder, poses: np.ndarray, times_s: np.ndarray) -> str:
    stamps = (1e9 * (1e9 + times_s)).round().astype(np.int64)
    trajectory.write_tum(folder / "way.txt", Trajectory(stamps, poses))
    return str(folder / "way.txt")


def test_looks_ahead_and_a_little_down():
    poses = camera_way(dataclasses.replace(WORLD, way=dataclasses.replace(POINTS, tremor=0.0))).poses(np.array([2.0]))
    np.testing.assert_allclose(optical_axis(poses), [[np.cos(np.deg2rad(8)), 0, -np.sin(np.deg2rad(8))]], atol=0.02)


def test_looks_at_a_point():
    way = dataclasses.replace(POINTS, look=(1.0, 5.0, 0.5), tremor=0.0)
    poses = camera_way(dataclasses.replace(WORLD, way=way)).poses(np.linspace(0, 10, 50))
    to_point = np.array([1.0, 5.0, 0.5]) - poses[:, 4:]
    to_point /= np.linalg.norm(to_point, axis=1, keepdims=True)
    np.testing.assert_allclose(optical_axis(poses), to_point, atol=1e-9)


def test_a_multirotor_leans_into_its_acceleration():
    """Measured: up to 32 degrees between up and the pull of the rotors without leaning, 5 with it, as it lags."""
    times_s = np.arange(0.0, 6.0, 0.01)
    away_deg = {}
    for flies in (False, True):
        way = dataclasses.replace(POINTS, speed_m_per_s=2.0, down_deg=0.0, tremor=0.0, flies=flies)
        poses = camera_way(dataclasses.replace(WORLD, way=way)).poses(times_s)
        pull = np.gradient(np.gradient(poses[:, 4:], times_s, axis=0), times_s, axis=0) + np.array([0.0, 0.0, 9.81])
        cosine = np.sum(-matrices(poses[:, :4])[:, :, 1] * pull, axis=1) / np.linalg.norm(pull, axis=1)
        away_deg[flies] = np.rad2deg(np.arccos(cosine[5:-5])).max()
    assert away_deg[False] > 20.0
    assert away_deg[True] < 8.0


def test_tremor_is_small_and_there():
    times_s = np.linspace(0, 10, 200)
    still, held = (
        camera_way(dataclasses.replace(WORLD, way=dataclasses.replace(POINTS, tremor=tremor))).poses(times_s)
        for tremor in (0.0, 1.0)
    )
    apart = np.linalg.norm(held[:, 4:] - still[:, 4:], axis=1)
    assert 0.001 < apart.max() < 0.006


def test_a_file_gives_its_poses_and_what_is_between(tmp_path):
    way, times_s = camera_way(WORLD), np.arange(0.0, 6.0, 0.05)
    file = saved(tmp_path, way.poses(times_s), times_s)
    read = camera_way(dataclasses.replace(WORLD, way=Way(file=file, from_s=1.0, tremor=0.0)))
    between = np.arange(0.0, 4.0, 0.0173)
    expected, got = way.poses(between + 1.0), read.poses(between)
    np.testing.assert_allclose(got[:, 4:], expected[:, 4:], atol=2e-4)
    assert np.abs(np.sum(got[:, :4] * expected[:, :4], axis=1)).min() > 1 - 1e-6


def test_a_file_is_placed_and_scaled(tmp_path):
    way, times_s = camera_way(WORLD), np.arange(0.0, 6.0, 0.05)
    placed = Way(file=saved(tmp_path, way.poses(times_s), times_s), at_m=(1.0, 2.0, 0.0), turn_deg=90, tremor=0.0)
    poses = camera_way(dataclasses.replace(WORLD, way=placed, scale=2.0)).poses(times_s[:50])
    x, y, z = way.poses(times_s[:50])[:, 4:].T
    np.testing.assert_allclose(poses[:, 4:], 2 * np.stack([1 - y, 2 + x, z], axis=1), atol=1e-5)
    ahead = optical_axis(way.poses(times_s[:50]))
    np.testing.assert_allclose(optical_axis(poses)[:, 0], -ahead[:, 1], atol=1e-5)


def test_a_file_of_a_body_that_carries_the_camera(tmp_path):
    way, times_s = camera_way(WORLD), np.arange(0.0, 6.0, 0.05)
    T_body_cam = (0.6, 0.0, 0.8, 0.0, 0.1, -0.2, 0.3)
    poses = way.poses(times_s)
    bodies = compose(poses, inverse(np.array([T_body_cam])))
    carried = Way(file=saved(tmp_path, bodies, times_s), T_body_cam=T_body_cam, tremor=0.0)
    got = camera_way(dataclasses.replace(WORLD, way=carried)).poses(times_s[:80])
    np.testing.assert_allclose(got[:, 4:], poses[:80, 4:], atol=1e-5)
    assert np.abs(np.sum(got[:, :4] * poses[:80, :4], axis=1)).min() > 1 - 1e-9
    with pytest.raises(ConfigError, match=r"Way.T_body_cam: expected a quaternion of length 1.*got length 2"):
        Way(file="way.txt", T_body_cam=(2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def test_noise_of_a_file_is_smoothed(tmp_path):
    way, times_s = (
        camera_way(dataclasses.replace(WORLD, way=dataclasses.replace(POINTS, tremor=0.0))),
        np.arange(0, 6, 0.03),
    )
    poses, rng = way.poses(times_s), np.random.default_rng(0)
    noise = np.concatenate([np.ones((200, 1)), rng.normal(0, 0.004, (200, 3)), rng.normal(0, 0.004, (200, 3))], axis=1)
    noise[::2, :4] *= -1  # the same rotations
    file, within = saved(tmp_path, compose(poses, noise), times_s), times_s[20:120]
    errors = []
    for smooth_s in (0.0, 0.2):
        read = camera_way(dataclasses.replace(WORLD, way=Way(file=file, smooth_s=smooth_s, tremor=0.0)))
        off = between(poses[20:120], read.poses(within))
        errors.append((np.sqrt(np.mean(angle(off) ** 2)), np.sqrt(np.mean(off[:, 4:] ** 2))))
    assert errors[1][0] < 0.6 * errors[0][0]
    assert errors[1][1] < 0.6 * errors[0][1]


def test_a_file_lies_beside_the_description(tmp_path):
    way, times_s = camera_way(WORLD), np.arange(0.0, 6.0, 0.05)
    saved(tmp_path, way.poses(times_s), times_s)
    camera = "camera: {width: 64, height: 48}"
    (tmp_path / "mine.yaml").write_text(f"about: A file.\nseconds: 4\n{camera}\nway: {{file: way.txt}}\n")
    recording = WorldRecording(load_world(tmp_path / "mine.yaml"))
    np.testing.assert_allclose(recording.ground_truth.T_world_cam[0, 4:], way.poses(times_s[:1])[0, 4:], atol=0.006)


def test_what_does_not_fit_is_named(tmp_path):
    way, times_s = camera_way(WORLD), np.arange(0.0, 3.0, 0.05)
    file = saved(tmp_path, way.poses(times_s), times_s)
    with pytest.raises(ConfigError, match=r"expected a trajectory of from_s \+ seconds, 4 s, got 2.950 s"):
        camera_way(dataclasses.replace(WORLD, way=Way(file=file)))
    with pytest.raises(ConfigError, match="expected points_m or a file, got both"):
        dataclasses.replace(POINTS, file=file)
    with pytest.raises(ConfigError, match="expected at least two points"):
        Way()
    with pytest.raises(TrajectoryError, match="nowhere"):
        camera_way(dataclasses.replace(WORLD, way=Way(file=str(tmp_path / "nowhere.txt"))))
