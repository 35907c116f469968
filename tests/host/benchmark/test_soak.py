"""A soak test of a small world: what is played, what is counted, and the files that it leaves."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from small_scene import clip

from jaxslam.benchmark.reports.soak import COLUMNS
from jaxslam.benchmark.soak.recordings import COVERED_FRAMES, Covered, FailingDetector, WithPeople
from jaxslam.cli.entry_point import main
from jaxslam.datasets import Subset
from jaxslam.datasets.to_and_fro import ToAndFro
from jaxslam.errors import ConfigError, DatasetError, ModelError
from jaxslam.semantics import Detections, no_detections
from jaxslam.sensors.frame import Frame
from jaxslam.worlds.library import load_world
from jaxslam.worlds.motion import RouteWalk
from jaxslam.worlds.passing_people import PassingPeople, without_people
from jaxslam.worlds.recording import WorldRecording

DELAY_NS = 7_000_000
ROOM = """
about: A room in which somebody walks about.
seconds: 0.4
rooms: [{size_m: [5, 4, 2.5], walls: bricks}]
things:
  - {kind: potted plant, at_m: [1.5, 1.2]}
  - {kind: suitcase, route: {points_m: [[1, -1], [1, 1]]}}
people: [{at_m: [1, 0]}]
camera: {width: 160, height: 120}
way: {points_m: [[-2, -0.3, 1.4], [-1.7, 0.3, 1.4]], look: [2, 0, 1.2], speed_m_per_s: 0.5}
"""


class LateDepth:
    """A recording whose depth is taken 7 ms after the image."""

    def __init__(self) -> None:
        self._frames = clip().frames[:4]
        self.name, self.camera, self.ground_truth = "late", clip().camera, None
        self.timestamps_ns = clip().timestamps_ns[:4]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        frame = self._frames[index]
        return dataclasses.replace(frame, depth_timestamp_ns=frame.timestamp_ns + DELAY_NS)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("world") / "room.yaml"
    path.write_text(ROOM)
    return path


def test_a_recording_goes_to_and_fro() -> None:
    source = Subset(clip(), 0, 4)
    played = ToAndFro(source, 12)
    assert played.source_of(np.arange(12)).tolist() == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1]
    steps_ns = np.diff(source.timestamps_ns)
    assert np.diff(played.timestamps_ns[:7]).tolist() == [*steps_ns, *steps_ns[::-1]]
    assert played[7].timestamp_ns == played.timestamps_ns[7]
    assert np.array_equal(played[7].image, source[1].image)
    assert np.array_equal(played[-1].image, source[1].image)
    truth, whole = played.ground_truth, source.ground_truth
    assert truth is not None
    assert whole is not None
    assert truth.timestamps_ns.tolist() == played.timestamps_ns.tolist()
    expected = whole.at(source.timestamps_ns).T_world_cam[played.source_of(np.arange(12))]
    assert np.array_equal(truth.T_world_cam, expected)
    with pytest.raises(IndexError):
        played[12]


def test_times_within_a_frame_are_reversed_on_the_way_back() -> None:
    played = ToAndFro(LateDepth(), 12)
    assert [played[index].played_backward for index in range(12)] == [False] * 4 + [True] * 3 + [False] * 3 + [True] * 2
    shown = [played[index] for index in (1, 5, 8)]
    assert [(frame.depth_timestamp_ns or 0) - frame.timestamp_ns for frame in shown] == [DELAY_NS, -DELAY_NS, DELAY_NS]
    covered = Covered(played, 5)
    assert covered.is_covered(5)
    assert covered[5].played_backward


@pytest.mark.parametrize(("frames", "played"), [(1, 5), (4, 0)])
def test_too_few_frames_are_an_error(frames: int, played: int) -> None:
    with pytest.raises(DatasetError, match="expected at least"):
        ToAndFro(Subset(clip(), 0, frames), played)


def test_the_lens_is_covered_at_intervals() -> None:
    recording = Covered(ToAndFro(Subset(clip(), 0, 4), 90), 40)
    covered = [index for index in range(90) if recording.is_covered(index)]
    assert covered == [*range(40, 40 + COVERED_FRAMES), *range(80, 90)]
    assert not recording[41].image.any()
    assert recording[39].image.any()
    assert not recording.may_be_lost(39)
    assert recording.may_be_lost(40 + COVERED_FRAMES)
    assert not any(Covered(ToAndFro(Subset(clip(), 0, 4), 90), 0).is_covered(index) for index in range(90))


def test_a_detector_fails_in_its_share() -> None:
    def nothing(image: np.ndarray, /) -> Detections:
        return no_detections()

    failing, failed = FailingDetector(nothing, 0.2), 0
    for _ in range(500):
        try:
            failing(np.zeros((4, 4, 3), np.uint8))
        except ModelError:
            failed += 1
    assert 60 < failed < 140


def test_people_are_others_each_time_and_all_else_stays(room: Path) -> None:
    alone = WorldRecording(without_people(load_world(room)))
    assert set(alone.labels) == {"potted plant"}
    people = PassingPeople(alone, 3)
    still = alone.render(5)
    shares = []
    for seed in range(2):
        frame, mask = people.frame(5, seed)
        assert frame.depth_m is not None
        unchanged = ~mask
        assert np.array_equal(frame.image[unchanged], still.rgb[unchanged])
        assert np.array_equal(frame.depth_m[unchanged], still.depth_m[unchanged])
        assert (people.render(5, seed).exact_depth_m <= still.exact_depth_m + 1e-6).all()
        again, _ = people.frame(5, seed)
        assert np.array_equal(again.image, frame.image)
        shares.append(mask.mean())
    assert max(shares) > 0.005
    assert shares[0] != shares[1]


def test_nobody_walks_through_the_camera(room: Path) -> None:
    """A lens that is covered by somebody is no test of a map."""
    alone = WorldRecording(without_people(load_world(room)))
    people = PassingPeople(alone, 3)
    times_s, camera_m = 1e-9 * (alone.timestamps_ns - alone.timestamps_ns[0]), alone.ground_truth.T_world_cam[:, 4:6]
    for seed in range(4):
        for person in people.people_of(seed):
            assert person.route is not None
            apart_m = np.linalg.norm(RouteWalk(person.route)(times_s).position - camera_m, axis=1)
            assert apart_m.min() >= 0.8


def test_the_detector_of_a_world_sees_the_people_of_each_way(room: Path) -> None:
    played = WithPeople(PassingPeople(WorldRecording(without_people(load_world(room))), 3), 40)
    found = [played.detect(played[index].image) for index in (2, 13, 24)]
    assert any(len(each.scores) for each in found)
    assert not len(played.detect(np.zeros((120, 160, 3), np.uint8)).scores)


def test_a_world_without_room_for_people_is_an_error() -> None:
    with pytest.raises(ConfigError, match="expected a room"):
        PassingPeople(WorldRecording(without_people(load_world("open"))), 1)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [[], ["--realtime"]])
def test_files_of_the_command(room: Path, tmp_path: Path, rate: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    wanted = ["--frames", "50", "--window", "20", "--covered-every", "25", "--size", "160x120", "--people", "2"]
    main(["bench", "soak", str(room), *wanted, *rate, "--out", str(tmp_path), "--json"])
    content = json.loads(capsys.readouterr().out)
    assert [window["frames"] for window in content["windows"]] == [20, 40, 50]
    assert rate or not content["dropped"]
    assert all(window["ate_m"] < 0.05 for window in content["windows"][:1])
    with (tmp_path / "soak.csv").open() as file:
        assert [int(row["frames"]) for row in csv.DictReader(file)] == [20, 40, 50]
    assert COLUMNS[0] in (tmp_path / "soak.md").read_text()
    assert (tmp_path / "soak.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("option", "value"), [("frames", "2"), ("window", "0"), ("people", "0"), ("detector-fails", "1.5"), ("size", "9x9")]
)
def test_wrong_options_are_errors_and_leave_no_folder(
    room: Path, tmp_path: Path, option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "soak", str(room), f"--{option}", value, "--out", str(tmp_path / "soak")])
    assert f"--{option}: expected" in capsys.readouterr().err
    assert not (tmp_path / "soak").exists()
