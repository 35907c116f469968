"""Worlds are told apart: which submap a pose is in, in results, trajectories, logs, and with a map from a file."""

import csv
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compile_counts import num_compiled
from replay import BLACK, SUBMAP, Played
from room_round import TRACK, other_room, room

from jaxslam.cli.entry_point import main
from jaxslam.config.schema import Config
from jaxslam.geometry.se3 import between
from jaxslam.map.npz_file import save_map
from jaxslam.map.types import empty_map
from jaxslam.results.run_results import RunInfo, write_results
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameRecord
from jaxslam.slam.slam import Slam
from jaxslam.slam.tracker import _track_followed
from jaxslam.tracking.state import TrackReason, TrackStatus
from jaxslam.trajectory.trajectory import read as read_trajectory

FPS = 15.0
QUICK = replace(SUBMAP, track=replace(TRACK, restart_after=5))
"""So few frames of a place that is not known until it is a submap."""
A, B = range(110, 140), range(60)
"""B ends so far from where it is met again that nothing of its last frame is seen there, as it is with 38 frames."""
ORDER = [*A, *[BLACK] * 3, *B, *[BLACK] * 3, *range(8, 26)]
"""A place, the lens covered, another place that nothing links to it, the lens covered, the second place again."""
SECOND = len(A) + 3


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[Played, Path, list[str]]:
    """Two unlinked worlds tracked; the file of their map; what was logged."""
    lines: list[str] = []
    log, handler = logging.getLogger("jaxslam.slam.status_log"), logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    log.addHandler(handler)
    level, _ = log.level, log.setLevel(logging.INFO)
    compiled = list[int]()
    try:
        with Slam(room().camera, QUICK) as slam:
            Played(slam, room(), ORDER[:2], FPS)
            compiled.append(num_compiled(_track_followed))
            slam.reset()
            lines.clear()
            result = Played(slam, room(), ORDER, FPS)
            compiled.append(num_compiled(_track_followed))
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
    assert compiled[0] == compiled[1]  # a relocalization, a restart and a reset compile the step no second time
    path = tmp_path_factory.mktemp("map") / "two.npz"
    slam.save(path)
    return result, path, lines


class TestResults:
    def test_statuses(self, played: tuple[Played, Path, list[str]]) -> None:
        """Started in A, begun anew in B, and relocalized there."""
        statuses = played[0].statuses
        assert statuses[0] == TrackStatus.STARTED
        began = statuses.index(TrackStatus.STARTED, 1)
        assert SECOND + TRACK.restart_after // 4 < began < SECOND + 15
        assert TrackStatus.RELOCALIZED in statuses[SECOND + len(B) + 3 :]

    def test_which_submap(self, played: tuple[Played, Path, list[str]]) -> None:
        """Every pose of B, relocalized ones too, is told to be in another world than the map's."""
        results = played[0].results
        began = played[0].first(TrackStatus.STARTED, 1)
        assert {(result.submap, result.in_map_frame) for result in results[:began]} == {(0, True)}
        assert {(result.submap, result.in_map_frame) for result in results[began:]} == {(1, False)}

    def test_trajectories_keep_them_apart(self, played: tuple[Played, Path, list[str]]) -> None:
        slam, results = played[0].slam, played[0].results
        assert sorted(slam.trajectories) == [0, 1]
        tracked = [sum(r.submap == n and r.status != TrackStatus.LOST for r in results) for n in (0, 1)]
        assert [len(slam.trajectories[number]) for number in (0, 1)] == tracked
        assert len(slam.trajectory) == len(slam.online_trajectory) == tracked[0] == len(A)
        np.testing.assert_array_equal(slam.trajectory.T_world_cam, slam.trajectories[0].T_world_cam)

    def test_reasons(self, played: tuple[Played, Path, list[str]]) -> None:
        """Of black frames that nothing could be followed; of B that it is not in the map; then why flow was lost."""
        results = played[0].results
        assert results[len(A)].reason == TrackReason.NO_POINTS.text
        began = played[0].first(TrackStatus.STARTED, 1)
        assert {result.reason for result in results[SECOND:began]} == {TrackReason.PLACE_NOT_IN_MAP.text}
        found = results[played[0].first(TrackStatus.RELOCALIZED)]
        assert found.reason in {reason.text for reason in TrackReason} - {""}

    def test_log(self, played: tuple[Played, Path, list[str]]) -> None:
        """Each beginning, loss and relocalization once."""
        words = [line.split(": ", 1)[1] for line in played[2]]
        found = [word for word in words if word.startswith("relocalized in submap 1 after")]
        assert len(found) == 1
        lost = f"lost: {TrackReason.NO_POINTS.text}"
        assert [word for word in words if word not in found] == ["submap 0 begins", lost, "submap 1 begins", lost]

    def test_covariance_where_a_world_begins(self, played: tuple[Played, Path, list[str]]) -> None:
        """It is the origin by definition."""
        for result in played[0].results:
            if result.status == TrackStatus.STARTED:
                np.testing.assert_allclose(result.covariance, 1e-12 * np.eye(6), rtol=1e-6)
            elif result.status != TrackStatus.LOST:
                assert 1e-10 < np.diag(result.covariance).min() < np.diag(result.covariance).max() < 0.1


class TestFiles:
    def test_results(self, played: tuple[Played, Path, list[str]], tmp_path: Path) -> None:
        """Each world has a trajectory of its own; those of an earlier run go."""
        (tmp_path / "trajectory_submap_7.txt").write_text("old")
        slam, recording = played[0].slam, room()
        records = [FrameRecord.of(result) for result in played[0].results]
        summary, _ = write_results(tmp_path, slam, records, RunInfo(recording, "default", 1.0))
        other = len(slam.trajectories[1])
        assert summary["poses_in_other_submaps"] == {"trajectory_submap_1.txt": other}
        assert len(read_trajectory(tmp_path / "trajectory.txt")) == len(A)
        assert len(read_trajectory(tmp_path / "trajectory_submap_1.txt")) == other
        assert not (tmp_path / "trajectory_submap_7.txt").exists()
        with (tmp_path / "frames.csv").open() as lines:
            assert {row["submap"] for row in csv.DictReader(lines)} == {"0", "1"}

    def test_export(
        self, played: tuple[Played, Path, list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """One world at a time, and it says which and what is left out."""
        submaps, file = played[0].slam.map.submap, tmp_path / "k.txt"
        for number in (0, 1):
            main(["export", str(played[1]), "--trajectory", str(file), "--submap", str(number)])
            assert len(read_trajectory(file)) == np.count_nonzero(submaps == number)
            expected = f"Submap {number}; left out, each in a world of its own: submaps [{1 - number}] (--submap N)"
            assert expected in capsys.readouterr().out


class TestLoaded:
    def test_in_the_second_world(self, played: tuple[Played, Path, list[str]]) -> None:
        """A start where only submap 1 has been is said to be there."""
        with Slam.load(played[1], config=QUICK) as slam:
            again = Played(slam, room(), [*range(10, 20)], FPS)
        assert again.statuses[0] == TrackStatus.RELOCALIZED
        assert {(result.submap, result.in_map_frame) for result in again.results} == {(1, False)}
        assert len(slam.trajectory) == 0
        assert len(slam.trajectories[1]) == 10

    def test_place_not_in_the_map(self, played: tuple[Played, Path, list[str]]) -> None:
        """Lost with that reason, then a submap of its own, that the map does not mix with what it knows."""
        with Slam.load(played[1], config=QUICK) as slam:
            other = Played(slam, other_room(), [*range(23)], FPS)
        began = other.statuses.index(TrackStatus.STARTED)
        assert 5 <= began <= 10
        assert {result.reason for result in other.results[:began]} == {TrackReason.PLACE_NOT_IN_MAP.text}
        after = other.results[began:]
        assert {(result.submap, result.in_map_frame) for result in after} == {(2, False)}
        assert np.unique(slam.map.submap).tolist() == [0, 1, 2]
        true = between(other.truth.T_world_cam[began][None], other.truth.T_world_cam[began:])
        given = np.array([result.T_world_cam for result in after])
        assert np.linalg.norm(between(given[:1], given)[:, 4:] - true[:, 4:], axis=1).max() < 0.03

    def test_only_to_localize(self, played: tuple[Played, Path, list[str]]) -> None:
        with Slam.load(played[1], config=QUICK, localize_only=True) as slam:
            other = Played(slam, other_room(), [*range(6)], FPS)
        assert set(other.statuses) == {TrackStatus.LOST}
        assert other.results[-1].reason == TrackReason.PLACE_NOT_IN_MAP.text

    def test_empty_map_is_none(self, tmp_path: Path) -> None:
        """A map saved with the lens covered does not keep the next start from tracking."""
        save_map(tmp_path / "empty.npz", empty_map(room().camera))
        with Slam.load(tmp_path / "empty.npz", config=Config(track=TRACK)) as slam:
            begun = Played(slam, room(), [*range(5)], FPS)
        assert begun.statuses == [TrackStatus.STARTED, *[TrackStatus.OK] * 4]
        assert begun.results[-1].in_map_frame


class TestMasked:
    def test_all_of_it(self) -> None:
        """A mask over everything is the reason, at the first frame and later."""
        frames = room()
        with Slam(frames.camera, Config(track=TRACK)) as slam:
            results = []
            for index in range(6):
                mask = np.full((240, 320), index in (0, 1, 5))
                results.append(slam.track(_masked(frames[index], mask)))
        assert [result.status for result in results[:3]] == [TrackStatus.LOST, TrackStatus.LOST, TrackStatus.STARTED]
        assert results[5].status == TrackStatus.LOST
        assert {results[index].reason for index in (0, 1, 5)} == {TrackReason.MASKED.text}


def _masked(frame: Frame, mask: np.ndarray) -> Frame:
    return Frame(frame.timestamp_ns, frame.image, frame.depth_m, dynamic_mask=mask)
