"""People of a real recording in rendered rooms: what is pasted, where, and what the masks say."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from real_networks import real_network

from jaxslam.datasets import open_dataset
from jaxslam.errors import ConfigError, DatasetError, ModelError
from jaxslam.semantics import load_detector
from jaxslam.sensors.camera import Camera
from jaxslam.worlds import World, WorldRecording, load_world, worlds
from jaxslam.worlds.description import Exposure, Fault, RealPeople, Room, Thing, Way, WorldCamera
from jaxslam.worlds.real_people import PeopleCutter

CUTTER = "deeplabv3_mobilenetv2_voc"
CROWDS = [name for name in worlds() if name.startswith("crowd_")]
SECONDS = 1.0
WAY = Way(((-2.5, 0.0, 1.4), (-2.4, 0.1, 1.4)), speed_m_per_s=0.1, look=(1.0, 0.0, 0.4))
ROOM = World("A room.", SECONDS, WAY, rooms=(Room((6.0, 5.0, 2.6)),), camera=WorldCamera(320, 240, fx=278.0))
NOWHERE = RealPeople("nowhere", "nowhere.onnx")


@pytest.fixture(scope="module")
def folder(data_dir: Path) -> Path:
    path = data_dir / "bonn" / "rgbd_bonn_crowd"
    if not path.is_dir():
        pytest.skip(f"JAXSLAM_DATA holds no {path.name}")
    return path


@pytest.fixture(scope="module")
def people(folder: Path) -> RealPeople:
    return RealPeople(str(folder), str(real_network(CUTTER)), from_s=14.0)


@pytest.fixture(scope="module")
def crowded(people: RealPeople) -> WorldRecording:
    return WorldRecording(dataclasses.replace(ROOM, real_people=people))


@pytest.fixture(scope="module")
def empty() -> WorldRecording:
    return WorldRecording(ROOM)


def cutter_of(world: World) -> PeopleCutter:
    assert world.real_people is not None
    return PeopleCutter(world.real_people, WorldRecording(dataclasses.replace(world, real_people=None)).camera, SECONDS)


def seen_by_pinhole(image: np.ndarray, recorded: Camera, camera: Camera) -> np.ndarray:
    """An image of a camera with distortion as another one without sees it, by projection of rays."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    K = np.array([[recorded.fx, 0, recorded.cx], [0, recorded.fy, recorded.cy], [0, 0, 1]])
    uv, _ = cv2.projectPoints(rays.reshape(-1, 3), np.zeros(3), np.zeros(3), K, np.array(recorded.distortion))
    columns, rows = uv.reshape(camera.height, camera.width, 2).astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(image, np.ascontiguousarray(columns), np.ascontiguousarray(rows), cv2.INTER_LINEAR)


@pytest.mark.parametrize("index", [0, 17, 29])
def test_masks_are_what_was_pasted(crowded, empty, index):
    frame, room = crowded.render(index), empty.render(index)
    number, mask = len(crowded.labels), frame.instance_mask == len(crowded.labels)
    assert (crowded.labels[number - 1], crowded.movable[number - 1]) == ("person", True)
    assert mask.mean() > 0.1
    np.testing.assert_array_equal(frame.moving_mask, mask)
    assert np.isnan(frame.T_world_instance[number - 1]).all()
    for field in ("rgb", "depth_m", "exact_depth_m", "instance_mask"):
        np.testing.assert_array_equal(getattr(frame, field)[~mask], getattr(room, field)[~mask])
    np.testing.assert_array_equal(frame.exact_depth_m[mask], frame.depth_m[mask])


@pytest.mark.parametrize("index", [0, 17, 29])
def test_people_are_those_of_the_nearest_frame_of_the_recording(crowded, folder, index):
    frame, recording = crowded.render(index), open_dataset(folder)
    since_s = 1e-9 * (recording.timestamps_ns - recording.timestamps_ns[0])
    recorded = recording[
        int(np.argmin(np.abs(since_s - 14.0 - 1e-9 * (frame.timestamp_ns - crowded.timestamps_ns[0]))))
    ]
    mask = frame.instance_mask == len(crowded.labels)
    expected = seen_by_pinhole(recorded.image, recording.camera, crowded.camera)
    difference = np.abs(frame.rgb.astype(int) - expected)[mask]
    assert np.percentile(difference, 99) <= 2  # remap knows 32 places within a pixel
    assert difference.max() < 20
    assert recorded.depth_m is not None
    depths_m = np.unique(frame.depth_m[mask])
    assert np.isin(depths_m, np.unique(recorded.depth_m)).all()
    assert np.median(depths_m[depths_m > 0]) < 4


def test_people_show_where_they_are_nearer_than_the_room(crowded, empty, people):
    frame, exact_m = crowded.render(5), empty.render(5).exact_depth_m
    cut = cutter_of(crowded.world).cut_out(5 / 30)
    np.testing.assert_array_equal(frame.instance_mask == 1, cut.mask & (cut.filled_m < exact_m))
    measured = (frame.instance_mask == 1) & (frame.depth_m > 0)
    assert np.mean(frame.depth_m[measured] < exact_m[measured]) > 0.99
    np.testing.assert_array_equal(frame.rgb[measured], cut.rgb[measured])
    np.testing.assert_array_equal(frame.depth_m[measured], cut.depth_m[measured])


def test_furniture_in_front_hides_people(crowded, people):
    wardrobe = Thing("wardrobe", (-1.7, -0.7))  # nearer than all people, over the right half
    blocked = WorldRecording(dataclasses.replace(ROOM, real_people=people, things=(wardrobe,)))
    before, frame = crowded.render(5), blocked.render(5)
    hidden = (before.instance_mask == 1) & (frame.instance_mask == 1)
    assert np.count_nonzero(hidden) > 1000
    assert (frame.exact_depth_m[hidden] < before.exact_depth_m[hidden])[before.exact_depth_m[hidden] > 0].all()
    still = frame.instance_mask == 2
    assert np.count_nonzero(still) > 1000
    np.testing.assert_array_equal(frame.rgb[still], before.rgb[still])


def test_the_same_bytes_in_any_order(crowded, people):
    again = WorldRecording(dataclasses.replace(ROOM, real_people=people))
    again.render(20)
    for field in ("rgb", "depth_m", "exact_depth_m", "instance_mask", "moving_mask"):
        np.testing.assert_array_equal(getattr(again.render(3), field), getattr(crowded.render(3), field))


def test_mirrored_people(people):
    camera = dataclasses.replace(ROOM.camera, cx=150.0)
    mirrored = dataclasses.replace(people, mirrored=True)
    there = cutter_of(dataclasses.replace(ROOM, real_people=people, camera=camera)).cut_out(0.5)
    other = dataclasses.replace(camera, cx=319.0 - 150.0)
    here = cutter_of(dataclasses.replace(ROOM, real_people=mirrored, camera=other)).cut_out(0.5)
    assert there.mask.any()
    for first, second in zip(there, here, strict=True):
        np.testing.assert_array_equal(first[:, ::-1], second)


def test_depth_grows_with_the_world(crowded, people):
    scaled = WorldRecording(dataclasses.replace(ROOM, real_people=people, scale=2.0))
    frame, big = crowded.render(8), scaled.render(8)
    both = (frame.instance_mask == 1) & (big.instance_mask == 1)
    assert both.sum() > 0.999 * (frame.instance_mask == 1).sum()
    np.testing.assert_array_equal(big.depth_m[both], 2 * frame.depth_m[both])


@pytest.mark.slow
def test_frozen_pictures_hold_the_people_of_their_moment(crowded, people):
    frozen = WorldRecording(dataclasses.replace(ROOM, real_people=people, faults=(Fault(0.5, 0.7, "frozen"),)))
    np.testing.assert_array_equal(frozen.render(20).rgb, crowded.render(14).rgb)
    np.testing.assert_array_equal(frozen.render(20).instance_mask, crowded.render(20).instance_mask)


def test_missing_depth_of_people_stays_missing(crowded):
    frames = [crowded.render(index) for index in (0, 10, 20)]
    missing = [np.mean(frame.depth_m[frame.instance_mask == 1] == 0) for frame in frames]
    assert min(missing) > 0
    assert max(missing) < 0.2


@pytest.mark.parametrize(
    "network", [pytest.param("yolov8n-seg_int8", marks=pytest.mark.slow), "deeplabv3_mobilenetv2_dm05_voc"]
)
@pytest.mark.slow
def test_networks_find_the_people(people, network):
    world = dataclasses.replace(ROOM, seconds=10.0, real_people=dataclasses.replace(people, from_s=12.0))
    recording = WorldRecording(dataclasses.replace(world, camera=WorldCamera(fx=555.0)))
    detector, true, found = load_detector(real_network(network)), 0, 0
    for index in range(10, 300, 48):
        frame = recording.render(index)
        given = detector(frame.rgb)
        mask = given.class_mask
        if mask is None:
            assert given.masks is not None
            mask = given.masks.any(axis=0)
        true, found = true + frame.moving_mask.sum(), found + (mask & frame.moving_mask).sum()
    assert found / true > 0.9  # 0.98 and 0.97 over all ten crowds


def test_what_cannot_be_opened_is_named(people, data_dir):
    def opened(seconds: float = 1.0, **changes: object) -> None:
        world = dataclasses.replace(ROOM, seconds=seconds, real_people=dataclasses.replace(people, **changes))
        WorldRecording(world)

    with pytest.raises(DatasetError, match=r"nowhere.*nothing there"):
        opened(recording="/nowhere")
    with pytest.raises(ModelError, match=r"nowhere\.onnx"):
        opened(network="/nowhere.onnx")
    with pytest.raises(ConfigError, match=r"expected one of from_s \+ seconds, 32 s, got 31\.069 s"):
        opened(from_s=22.0, seconds=10.0)
    with pytest.raises(ConfigError, match=r"RealPeople.network: expected one that gives masks, got boxes"):
        opened(network=str(real_network("yolox_nano")))
    with pytest.raises(ConfigError, match=r"RealPeople.recording: expected one with depth"):
        opened(recording=str(data_dir / "kitti" / "sequences" / "06"), from_s=0.0)


@pytest.mark.parametrize("variable", ["JAXSLAM_DATA", "JAXSLAM_MODELS"])
def test_a_missing_variable_is_named(people, monkeypatch, variable):
    monkeypatch.delenv(variable, raising=False)
    changed = {"JAXSLAM_DATA": "recording", "JAXSLAM_MODELS": "network"}[variable]
    there = dataclasses.replace(people, **{changed: f"${variable}/there"})
    with pytest.raises(ConfigError, match=rf"{variable}: expected the folder in which '\${variable}/there' lies"):
        WorldRecording(dataclasses.replace(ROOM, real_people=there))


def test_paths_are_beside_the_description(tmp_path):
    given = "real_people: {recording: crowd, network: $JAXSLAM_MODELS/net.onnx, from_s: 3}"
    way = "way: {points_m: [[0, 0, 1], [1, 0, 1]]}"
    (tmp_path / "mine.yaml").write_text(f"about: A room.\nseconds: 1\n{way}\n{given}\n")
    people = load_world(tmp_path / "mine.yaml").real_people
    assert people == RealPeople(str(tmp_path / "crowd"), "$JAXSLAM_MODELS/net.onnx", 3.0)


def test_what_real_people_cannot_follow_is_refused():
    with pytest.raises(ConfigError, match=r"World.real_people: expected a camera with depth, got a stereo pair"):
        dataclasses.replace(ROOM, real_people=NOWHERE, camera=WorldCamera(baseline_m=0.1))
    with pytest.raises(ConfigError, match=r"World.exposure: expected none with real_people"):
        dataclasses.replace(ROOM, real_people=NOWHERE, exposure=(Exposure(1.0, 0.5),))


def test_there_are_ten_rooms_that_differ():
    rooms = [load_world(name) for name in CROWDS]
    assert len(rooms) >= 10
    for field in ("rooms", "things", "way", "real_people"):
        values = [getattr(each, field) for each in rooms]
        assert all(values.count(value) == 1 for value in values)


@pytest.mark.slow
@pytest.mark.parametrize("name", CROWDS)
def test_people_are_in_view_most_of_the_time(name, folder, data_dir, monkeypatch):
    monkeypatch.setenv("JAXSLAM_MODELS", str(real_network(CUTTER).parent))
    monkeypatch.setenv("JAXSLAM_DATA", str(data_dir))
    recording = WorldRecording(name)
    shares = [np.mean(recording.render(index).moving_mask) for index in range(15, 300, 54)]
    assert np.mean(np.array(shares) > 0.03) >= 0.8
    assert np.mean(shares) > 0.1
