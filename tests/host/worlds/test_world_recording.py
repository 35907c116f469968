"""Recordings of worlds against their own truth."""

import dataclasses
import itertools
import subprocess
import sys

import cv2
import numpy as np
import pytest

from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic import PERFECT_SENSOR
from jaxslam.datasets.synthetic.homogeneous import inverse, matrix_from_pose
from jaxslam.datasets.synthetic.write_tum import write_tum
from jaxslam.errors import ConfigError
from jaxslam.worlds import World, WorldRecording, load_world, worlds
from jaxslam.worlds.description import (
    Exposure,
    Fault,
    Hand,
    LightChange,
    Lighting,
    Person,
    Room,
    Route,
    Thing,
    Way,
    WorldCamera,
)

CAMERA = WorldCamera(width=160, height=120)
PERFECT = dataclasses.replace(CAMERA, sensor=PERFECT_SENSOR)
ROOM = World(
    about="A room.",
    seconds=6.0,
    way=Way(((-1.5, 0.0, 1.4), (-1.2, 0.5, 1.4)), speed_m_per_s=0.3, look=(1.0, 0.0, 0.8)),
    rooms=(Room((5.0, 4.0, 2.5)),),
    things=(
        Thing("dining table", (1.0, 0.5), turn_deg=90),
        Thing("chair", (0.6, -0.6), until_s=2.0),
        Thing("carton", (0.2, 0.2), route=Route(((0.2, 1.0), (0.2, -1.0)), 0.5)),
    ),
    people=(Person(route=Route(((1.8, -1.0), (1.8, 1.0)), 0.8), carries="carton"), Person((1.9, 1.6), 180.0)),
    camera=PERFECT,
)
TABLE, CHAIR, CARTON, WALKER, STANDER = range(1, 6)


@pytest.fixture(scope="module")
def room() -> WorldRecording:
    return WorldRecording(ROOM)


def points(recording: WorldRecording, frame) -> np.ndarray:
    """Points of all pixels in the camera, `(h, w, 3)`."""
    camera = recording.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return rays * frame.exact_depth_m[..., None].astype(np.float64)


def moved(matrix: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return xyz @ matrix[:3, :3].T + matrix[:3, 3]


def test_labels_and_numbers(room):
    assert room.labels == ("dining table", "chair", "box", "person", "person")
    assert room.movable == (False, True, True, True, True)
    frame = room.render(0)
    assert set(np.unique(frame.instance_mask)) == {0, TABLE, CHAIR, CARTON, WALKER, STANDER}


def test_what_moves_is_in_the_mask_and_nothing_else(room):
    for index in (20, 45, 100):  # not while they turn, at rest for a moment
        frame = room.render(index)
        np.testing.assert_array_equal(frame.moving_mask, np.isin(frame.instance_mask, [CARTON, WALKER]))


def test_a_thing_is_gone_after_its_time(room):
    assert (room.render(59).instance_mask == CHAIR).any()
    assert not (room.render(60).instance_mask == CHAIR).any()


@pytest.mark.parametrize("number", [0, TABLE, CARTON])
def test_points_of_a_frame_are_found_in_the_next_by_truth(room, number):
    """Depth, poses of the camera and of rigid movers, and numbers agree with each other."""
    first, second = room.render(10), room.render(13)
    here = first.instance_mask == number
    world = moved(matrix_from_pose(first.T_world_cam), points(room, first)[here])
    if number:
        then, now = (matrix_from_pose(frame.T_world_instance[number - 1]) for frame in (first, second))
        world = moved(now @ inverse(then), world)
    x, y, z = moved(inverse(matrix_from_pose(second.T_world_cam)), world).T
    camera = room.camera
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    u, v, z = (values[inside] for values in (u, v, z))
    # Inverse depth is linear in the pixels of a plane.
    seen = (
        1.0
        / cv2.remap(
            (1.0 / second.exact_depth_m).astype(np.float32),
            u.astype(np.float32),
            v.astype(np.float32),
            cv2.INTER_LINEAR,
        ).ravel()
    )
    error = np.abs(seen - z)
    assert inside.sum() > 100
    assert np.median(error) < 1e-3
    # The others are at edges, or hidden.
    assert np.mean(error < 5e-3) > 0.75


def test_floor_and_walls_are_where_they_are(room):
    frame = room.render(0)
    world = moved(matrix_from_pose(frame.T_world_cam), points(room, frame)[frame.instance_mask == 0])
    for distance in (world[:, 2], 2.5 - world[:, 0]):
        assert distance.min() > -1e-4
        assert np.count_nonzero(distance < 1e-4) > 500


def test_intrinsics_are_those_given():
    camera = dataclasses.replace(PERFECT, fx=140.0, fy=120.0, cx=60.0, cy=70.0)
    recording = WorldRecording(dataclasses.replace(ROOM, camera=camera))
    assert (recording.camera.fx, recording.camera.fy, recording.camera.cx, recording.camera.cy) == (140, 120, 60, 70)
    frame = recording.render(0)
    height_m = moved(matrix_from_pose(frame.T_world_cam), points(recording, frame)[frame.instance_mask == 0])[:, 2]
    assert np.count_nonzero(np.abs(height_m) < 1e-4) > 500
    assert height_m.min() > -1e-4


def test_nothing_is_behind_the_backdrop():
    open_place = dataclasses.replace(ROOM, rooms=(), people=())
    frame = WorldRecording(open_place).render(0)
    assert (frame.exact_depth_m[frame.instance_mask == 0] == 0).all()
    assert (frame.depth_m[frame.instance_mask == 0] == 0).all()


def test_exposure_changes_the_brightness():
    dark = dataclasses.replace(ROOM, exposure=(Exposure(1.0, 0.3, over_s=0.1), Exposure(2.0, 2.0)))
    usual, changed = WorldRecording(ROOM), WorldRecording(dark)
    for index, factor in ((29, 1.0), (31, 1.0 - 0.7 / 3), (40, 0.3), (59, 0.3)):
        before, after = (recording.render(index).rgb.astype(np.float64) for recording in (usual, changed))
        assert np.median(after[before > 60] / before[before > 60]) == pytest.approx(factor, abs=0.02)
    assert changed.render(70).rgb.mean() > usual.render(70).rgb.mean() + 20


def test_missing_frames_leave_the_others_as_they_are(room):
    gap = WorldRecording(dataclasses.replace(ROOM, faults=(Fault(1.0, 1.5),)))
    assert len(gap) == len(room) - 15
    assert np.diff(gap.timestamps_ns).max() == pytest.approx(16e9 / 30, rel=1e-5)
    np.testing.assert_array_equal(gap.render(40).rgb, room.render(55).rgb)
    np.testing.assert_array_equal(gap.ground_truth.T_world_cam[40], room.ground_truth.T_world_cam[55])


def test_black_and_frozen_frames_keep_their_truth(room):
    faults = Fault(0.5, 0.6, "black"), Fault(1.0, 1.2, "frozen")
    faulty = WorldRecording(dataclasses.replace(ROOM, faults=faults))
    black, frozen = faulty.render(16), faulty.render(33)
    assert not black.rgb.any()
    assert not black.depth_m.any()
    np.testing.assert_array_equal(frozen.rgb, room.render(29).rgb)
    for frame, index in ((black, 16), (frozen, 33)):
        np.testing.assert_array_equal(frame.exact_depth_m, room.render(index).exact_depth_m)
        np.testing.assert_array_equal(frame.T_world_cam, room.render(index).T_world_cam)
    np.testing.assert_array_equal(faulty.render(36).rgb, room.render(36).rgb)


def test_no_frames_at_all_is_an_error():
    with pytest.raises(ConfigError, match="expected some frames that are not missing"):
        WorldRecording(dataclasses.replace(ROOM, faults=(Fault(0.0, 10.0),)))


@pytest.mark.parametrize("scale", [4.0, 0.3])
def test_a_scaled_world_looks_the_same_and_measures_in_proportion(room, scale):
    scaled = WorldRecording(dataclasses.replace(ROOM, scale=scale))
    frame, big = room.render(40), scaled.render(40)
    assert np.mean(frame.instance_mask == big.instance_mask) > 0.999
    # Textures hold eight digits of their lengths: only powers of two change nothing.
    assert np.mean(np.abs(frame.rgb.astype(int) - big.rgb) > 2) < (0.001 if scale == 4.0 else 0.12)
    assert np.median(np.abs(big.exact_depth_m / frame.exact_depth_m / scale - 1)) < 1e-6
    np.testing.assert_allclose(big.T_world_cam[4:], scale * frame.T_world_cam[4:], rtol=1e-12)
    np.testing.assert_allclose(big.T_world_instance[:, 4:], scale * frame.T_world_instance[:, 4:], rtol=1e-12)


def test_the_sensor_of_a_scaled_world_is_scaled_too():
    usual, big = (WorldRecording(dataclasses.replace(ROOM, camera=CAMERA, scale=scale)) for scale in (1.0, 4.0))
    frame, scaled = usual.render(0), big.render(0)
    both = (frame.depth_m > 0) & (scaled.depth_m > 0)
    assert both.mean() > 0.6
    assert np.mean((frame.depth_m > 0) == (scaled.depth_m > 0)) > 0.99
    np.testing.assert_allclose(scaled.depth_m[both], 4 * frame.depth_m[both], rtol=1e-3)


def test_a_pair_sees_the_same_from_two_places():
    recording = WorldRecording(dataclasses.replace(ROOM, camera=dataclasses.replace(PERFECT, baseline_m=0.1)))
    frame, camera = recording.render(0), recording.camera
    assert frame.right is not None
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    from_right = cv2.remap(frame.right, u - np.float32(camera.fx * 0.1) / frame.exact_depth_m, v, cv2.INTER_LINEAR)
    difference = np.abs(from_right.astype(int) - frame.rgb.astype(int)).max(axis=2)[:, 30:]
    assert np.median(difference) < 8
    assert recording[0].depth_m is None


def test_frames_do_not_depend_on_their_order(room):
    again = WorldRecording(ROOM)
    later = again.render(50)
    for recording in (room, again):
        frame = recording.render(50)
        for field in ("rgb", "depth_m", "exact_depth_m", "instance_mask", "T_world_instance"):
            np.testing.assert_array_equal(getattr(frame, field), getattr(later, field))


def test_another_process_renders_the_same_bytes():
    code = (
        "import hashlib\nfrom jaxslam.worlds import WorldRecording\nframe = WorldRecording('kitchen').render(33)\n"
        "print(hashlib.sha256(frame.rgb.tobytes() + frame.depth_m.tobytes()).hexdigest())"
    )
    digests = {
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    }
    assert len(digests) == 1


def test_other_seeds_look_otherwise(room):
    other = WorldRecording(dataclasses.replace(ROOM, seed=1)).render(0)
    assert np.abs(other.rgb.astype(int) - room.render(0).rgb.astype(int)).mean() > 5


def test_is_written_as_tum_with_numbers_and_labels(tmp_path):
    short = WorldRecording(dataclasses.replace(ROOM, seconds=0.1, camera=CAMERA))
    write_tum(short, tmp_path / "room", texts={"labels.txt": short.labels_text()})
    read = open_dataset(tmp_path / "room")
    assert len(read) == len(short) == 3
    np.testing.assert_array_equal(read[1].image, short[1].image)
    depth_m, expected_m = read[1].depth_m, short[1].depth_m
    assert depth_m is not None
    assert expected_m is not None
    np.testing.assert_allclose(depth_m, expected_m, atol=1.1e-4)
    assert read.ground_truth is not None
    np.testing.assert_allclose(read.ground_truth.T_world_cam, short.ground_truth.T_world_cam, atol=1e-6)
    number = cv2.imread(str(min((tmp_path / "room" / "instance").glob("*.png"))), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(number, short.render(0).instance_mask)
    moving = cv2.imread(str(min((tmp_path / "room" / "mask").glob("*.png"))), cv2.IMREAD_UNCHANGED)
    assert moving is not None
    np.testing.assert_array_equal(moving > 0, short.render(0).moving_mask)
    assert "4 1 person" in (tmp_path / "room" / "labels.txt").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", worlds())
def test_the_camera_of_every_world_keeps_clear_of_everything(name, request):
    """Real people and hands are left out: people stay where they were recorded, and a hand is to cover the lens."""
    world = dataclasses.replace(load_world(name), real_people=None, hands=())
    if world.way.file is not None:
        request.getfixturevalue("data_dir")
    small = dataclasses.replace(world.camera, width=160, height=120, fx=None, fy=None, cx=None, cy=None)
    recording = WorldRecording(dataclasses.replace(world, camera=small))
    for index in np.linspace(0, len(recording) - 1, 40).astype(int):
        frame = recording.render(int(index))
        assert frame.exact_depth_m[frame.exact_depth_m > 0].min() > 0.25, f"frame {index}"


FAST = dataclasses.replace(
    ROOM,
    things=(),
    people=(),
    way=Way(((-1.5, 0.0, 1.4), (-1.0, 1.0, 1.4)), speed_m_per_s=1.0, turn_s=1.6, pause_s=0.2),
)
ROLLS = dataclasses.replace(PERFECT, rolling_shutter_s=0.03)


def test_each_row_of_a_rolling_shutter_is_taken_from_its_own_pose():
    recording = WorldRecording(dataclasses.replace(FAST, camera=ROLLS))
    turns = [abs(first @ second) for first, second in itertools.pairwise(recording.ground_truth.T_world_cam[:, :4])]
    index = int(np.argmin(turns))  # while it turns fastest
    frame = recording.render(index)
    times = 1e-9 * (recording.timestamps_ns[index] - recording.timestamps_ns[0]) + 0.03 * np.linspace(-0.5, 0.5, 120)
    poses = matrix_from_pose(recording._way.poses(times))
    turn_deg = np.rad2deg(np.arccos((np.trace(poses[0, :3, :3].T @ poses[-1, :3, :3]) - 1.0) / 2.0))
    assert turn_deg > 2.0
    inside = np.abs(points(recording, frame) @ [0, 0, 1.0]) > 0
    for row in (0, 30, 59, 60, 90, 119):
        world = moved(poses[row], points(recording, frame)[row])
        planes = [world[:, 2], world[:, 2] - 2.5, np.abs(world[:, 0]) - 2.5, np.abs(world[:, 1]) - 2.0]
        floor_or_wall = np.abs(planes).min(axis=0)
        assert inside[row].all()
        # Pictures hang a centimeter before the walls.
        assert np.median(floor_or_wall) < 2e-3
        if row in {0, 119}:
            taken_at_once = moved(poses[60], points(recording, frame)[row])
            assert np.median(np.abs(taken_at_once - world).max(axis=1)) > 0.03
        assert floor_or_wall.max() < 0.03


def test_a_camera_at_rest_sees_the_same_with_a_rolling_shutter(room):
    rest = Way(((-1.5, 0.0, 1.4), (-1.2, 0.5, 1.4)), pause_s=30.0, look=(1.0, 0.0, 0.8), tremor=0.0)
    still = dataclasses.replace(ROOM, things=ROOM.things[:1], people=ROOM.people[1:], way=rest)
    whole, rolling = (WorldRecording(dataclasses.replace(still, camera=each)).render(60) for each in (PERFECT, ROLLS))
    np.testing.assert_allclose(whole.exact_depth_m, rolling.exact_depth_m, rtol=1e-5)
    assert np.mean(whole.rgb != rolling.rgb) < 1e-3


def test_vignetting_darkens_the_corners_and_gamma_brightens_the_dark(room):
    plain = room.render(0).rgb.astype(np.float64)
    dim = WorldRecording(dataclasses.replace(ROOM, camera=dataclasses.replace(PERFECT, vignetting=0.5)))
    ratio = np.divide(dim.render(0).rgb, plain, where=plain > 80, out=np.full(plain.shape, np.nan))
    assert np.nanmedian(ratio[55:65, 75:85]) == pytest.approx(1.0, abs=0.01)
    assert np.nanmedian(ratio[:6, :8]) == pytest.approx(0.53, abs=0.03)
    bright = WorldRecording(dataclasses.replace(ROOM, camera=dataclasses.replace(PERFECT, gamma=2.2)))
    np.testing.assert_allclose(bright.render(0).rgb, 255.0 * (plain / 255.0) ** (1 / 2.2), atol=3.0 + 0.0)


def test_lamps_flicker_from_frame_to_frame_and_band_by_band():
    lamps = Lighting(flicker=0.3, flicker_hz=104.0)
    flickering = dataclasses.replace(ROOM, lighting=lamps)
    usual, changed = WorldRecording(ROOM), WorldRecording(flickering)
    ratios = [np.median(changed.render(k).rgb[60:] / np.maximum(usual.render(k).rgb[60:], 1.0)) for k in range(0, 9, 2)]
    assert np.ptp(ratios) > 0.2
    usual, changed = (
        WorldRecording(dataclasses.replace(world, camera=ROLLS)).render(0).rgb.astype(np.float64)
        for world in (ROOM, flickering)
    )
    rows = np.median(changed / np.maximum(usual, 1.0), axis=(1, 2))
    expected = 1.0 + 0.3 * np.sin(2.0 * np.pi * 104.0 * 0.03 * np.linspace(-0.5, 0.5, 120))
    np.testing.assert_allclose(rows, expected, atol=0.03)


def test_another_light_comes_at_its_time():
    later = LightChange(1.0, Lighting(brightness=0.4), over_s=1.0)
    usual, changed = WorldRecording(ROOM), WorldRecording(dataclasses.replace(ROOM, light_changes=(later,)))
    np.testing.assert_array_equal(usual.render(29).rgb, changed.render(29).rgb)
    for index, factor in ((45, 0.5 * (1.0 + 0.4 / 1.1)), (70, 0.4 / 1.1)):
        before, after = (recording.render(index).rgb.astype(np.float64) for recording in (usual, changed))
        assert np.median(after[before > 80] / before[before > 80]) == pytest.approx(factor, abs=0.02)


def test_a_hand_comes_before_the_lens_and_goes():
    recording = WorldRecording(dataclasses.replace(ROOM, hands=(Hand(1.0, 2.0, covers=0.8),)))
    number = len(recording.labels)
    assert recording.labels[-1] == "person"
    there = [recording.render(index).instance_mask == number for index in (29, 33, 45, 61)]
    assert not there[0].any()
    assert not there[3].any()
    assert 0 < there[1].sum() < there[2].sum()
    assert there[2].mean() > 0.15
    assert there[2].any(axis=1).argmax() == pytest.approx(0.2 * 120, abs=3)
    frame = recording.render(45)
    assert frame.moving_mask[there[2]].all()
    assert frame.exact_depth_m[there[2]].max() < 0.25


@pytest.mark.parametrize("ends", ["reverse", "back"])
def test_a_camera_that_reverses_does_not_turn(ends):
    way = Way(((-1.5, 0.0, 1.4), (1.0, 0.0, 1.4)), speed_m_per_s=1.0, ends=ends, pause_s=0.4, turn_s=0.6, down_deg=0)
    poses = WorldRecording(dataclasses.replace(ROOM, way=way)).ground_truth.T_world_cam
    ahead = matrix_from_pose(poses)[:, :3, 2]
    turned = np.rad2deg(np.arccos(np.clip(ahead @ ahead[30], -1.0, 1.0))).max()
    assert turned < 1.0 if ends == "reverse" else turned > 170.0
    assert poses[:, 4].max() > 0.8
    assert abs(poses[-30, 4] - poses[0, 4]) < 1.5


@pytest.mark.slow
def test_frames_are_the_same_bytes_on_one_core():
    code = (
        "import hashlib\n"
        "from jaxslam.worlds import WorldRecording\n"
        "frame = WorldRecording('kitchen').render(30)\n"
        "print(hashlib.sha256(frame.rgb.tobytes() + frame.depth_m.tobytes()).hexdigest())\n"
    )
    pinned = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
    printed = [
        subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True).stdout
        for text in (code, pinned + code)
    ]
    assert printed[0] == printed[1]


def test_nothing_of_the_start_is_missing_while_the_first_picture_is_exposed():
    """A thing that leaves later is as solid in the first picture as one that stays."""
    blurred = dataclasses.replace(CAMERA, sensor=dataclasses.replace(PERFECT_SENSOR, exposure_s=0.02))
    stays = dataclasses.replace(ROOM, things=(Thing("chair", (0.6, -0.6)),), people=(), camera=blurred)
    leaves = dataclasses.replace(stays, things=(Thing("chair", (0.6, -0.6), until_s=2.0),))
    first, second = (WorldRecording(world).render(0).rgb for world in (stays, leaves))
    np.testing.assert_array_equal(first, second)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length():
    code = (
        "import dataclasses, psutil\n"
        "from jaxslam.worlds import WorldRecording, load_world\n"
        "kitchen = load_world('kitchen')\n"
        "camera = dataclasses.replace(kitchen.camera, width=160, height=120)\n"
        "recording = WorldRecording(dataclasses.replace(kitchen, seconds=70, camera=camera))\n"
        "used = []\n"
        "for index in range(2100):\n"
        "    recording.render(index)\n"
        "    if index in (99, 2099):\n"
        "        used.append(psutil.Process().memory_info().rss)\n"
        "print((used[1] - used[0]) / 2**20)\n"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert float(printed) < 50
