"""Suites of worlds: what they need, their true masks, and a small part of the one that only tests track."""

import dataclasses
import os

import numpy as np
import pytest
from real_networks import real_network

from jaxslam import Slam, TrackStatus, load_config
from jaxslam.benchmark.suites.job import Job
from jaxslam.benchmark.suites.plan import fingerprint, missing, plan
from jaxslam.benchmark.suites.suite import Sequence, load_suite
from jaxslam.datasets import Subset
from jaxslam.datasets.synthetic import SceneDetector, with_true_masks
from jaxslam.errors import BenchmarkError, ConfigError
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.worlds import Fault, Person, Room, Route, Thing, Way, World, WorldCamera, WorldRecording, load_world
from jaxslam.worlds.stored_world import why_not_here

FRAMES = 10


def test_the_gate_tracks_a_small_part_of_each_suite_that_needs_no_data():
    gated = {clip.world for clip in load_suite("worlds").sequences}
    for name in ("flat", "road", "light", "changes", "flight"):
        assert gated & {clip.world for clip in load_suite(name).sequences}
    assert not missing(load_suite("worlds"), ())


@pytest.mark.slow
def test_a_small_part_of_a_room_with_real_people_is_tracked(monkeypatch):
    """The camera moves by more than the error allowed, which is a hundredth of that or 1 cm."""
    monkeypatch.setenv("JAXSLAM_MODELS", str(real_network("deeplabv3_mobilenetv2_voc").parent))
    clip = load_suite("crowd_in_rooms").sequences[0]
    world = load_world(clip.world)
    if (why := why_not_here(world)) is not None:
        pytest.skip(why)
    whole = WorldRecording(world)
    part = Subset(whole, clip.start, clip.start + FRAMES * clip.every, clip.every)
    config = load_config("default", overrides=("semantics.model=scene",))
    dataset, detector = with_true_masks(part, config.semantics)
    with Slam(dataset.camera, config, detector=detector) as slam:
        records = slam.run(dataset)
    assert all(record.status is not TrackStatus.LOST for record in records)
    truth = dataset.ground_truth
    assert truth is not None
    path = truth.select(np.isin(truth.timestamps_ns, part.timestamps_ns)).T_world_cam[:, 4:]
    moved_m = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert evaluate(slam.trajectory, truth).ate_rmse_m < max(0.01 * moved_m, 0.01)


def test_a_sequence_is_of_one_kind():
    with pytest.raises(BenchmarkError, match="expected one of `recording`, `room` and `world`, got 2"):
        Sequence("both", recording="rgbd_bonn_crowd", world="flat")
    with pytest.raises(BenchmarkError, match="got none"):
        Sequence("none")


def test_a_world_beside_a_suite_is_found_and_known_by_its_content(tmp_path):
    (tmp_path / "my_world.yaml").write_text("about: A.\nseconds: 1\nway: {points_m: [[0, 0, 1], [1, 0, 1]]}\n")
    path = tmp_path / "mine.yaml"
    path.write_text("sequences: [{world: my_world.yaml, stop: 5}, {world: flat}]\n")
    suite = load_suite(str(path))
    assert [clip.name for clip in suite.sequences] == ["my_world", "flat"]
    assert suite.sequences[0].source == str(tmp_path / "my_world.yaml")
    job = plan(suite)[0]
    assert Job.of_json(job.to_json()) == job
    before = fingerprint(plan(suite))
    (tmp_path / "my_world.yaml").write_text("about: B.\nseconds: 1\nway: {points_m: [[0, 0, 1], [1, 0, 1]]}\n")
    assert fingerprint(plan(suite)) != before


def test_worlds_that_need_recordings_are_missing_without_them(monkeypatch):
    monkeypatch.delenv("JAXSLAM_DATA", raising=False)
    absent = missing(load_suite("flight"), ())
    assert set(absent) == {"flight_v103", "flight_v202"}
    assert all("JAXSLAM_DATA" in why for why in absent.values())
    assert not missing(load_suite("road"), ())


@pytest.mark.skipif("JAXSLAM_DATA" not in os.environ, reason="needs JAXSLAM_DATA")
def test_worlds_whose_recordings_are_there_are_not_missing():
    assert not missing(load_suite("flight"), ())


WORLD = World(
    about="A room with a person and a carton that move, before a camera that fails.",
    seconds=1.0,
    way=Way(((-1.5, 0.0, 1.4), (-1.2, 0.5, 1.4)), speed_m_per_s=0.3, look=(1.0, 0.0, 0.8)),
    rooms=(Room((5.0, 4.0, 2.5)),),
    things=(Thing("carton", route=Route(((0.6, 0.8), (0.6, -0.8)), 1.5)), Thing("chair", (1.2, 1.0))),
    people=(Person(route=Route(((1.4, -0.8), (1.4, 0.8)), 1.2)),),
    faults=(Fault(0.3, 0.5, "frozen"), Fault(0.7, 0.8, "black")),
    camera=WorldCamera(width=160, height=120),
)


@pytest.fixture(scope="module")
def world() -> WorldRecording:
    return WorldRecording(WORLD)


@pytest.mark.parametrize(
    ("labels", "found"), [(("person",), ["person"]), (("box", "chair"), ["box", "chair"]), ((), [])]
)
def test_true_masks_are_those_of_the_labels(world, labels, found):
    detections = SceneDetector(world, labels=labels)(world.render(2).rgb)
    assert sorted(detections.labels) == found
    if found:
        assert detections.masks is not None
        numbers = {world.labels[number - 1]: number for number in range(1, 4)}
        for label, mask in zip(detections.labels, detections.masks, strict=True):
            np.testing.assert_array_equal(mask, world.render(2).instance_mask == numbers[label])


def test_a_frozen_picture_has_the_masks_of_what_it_shows_and_a_black_one_none(world):
    detector = SceneDetector(world)
    for index in range(len(world)):
        detector.note(world.render(index))
    shown = world.render(8)
    masks = detector(world.render(13).rgb).masks
    assert masks is not None
    np.testing.assert_array_equal(masks.any(axis=0), np.isin(shown.instance_mask, [1, 3]))
    assert not len(detector(world.render(22).rgb).labels)


def test_an_unknown_label_is_an_error(world):
    with pytest.raises(ConfigError, match=r"labels: expected classes .* got 'persn'"):
        SceneDetector(world, labels=("persn",))


def test_more_instances_than_a_byte_holds():
    many = dataclasses.replace(WORLD, things=tuple(Thing("carton", (1.0, 0.0), until_s=0.5) for _ in range(300)))
    world = WorldRecording(many)
    detections = SceneDetector(world)(world.render(0).rgb)
    person = world.render(0).instance_mask == 301
    assert detections.masks is not None
    index = detections.labels.index("person")
    np.testing.assert_array_equal(detections.masks[index], person)
