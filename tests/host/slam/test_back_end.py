"""The back end under `Slam`: determinism, threads that end, errors that reach the caller, compiling once."""

import dataclasses
import functools
import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from small_scene import HEIGHT, TRACK, WIDTH, Clip

from jaxslam.config.schema import Config, MappingConfig, RunConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import angle, between, compose
from jaxslam.loop_closing.loop_detector import LoopClosing, LoopClosure
from jaxslam.map.types import Map, empty_map
from jaxslam.map.validate import problems
from jaxslam.mapping.global_bundle_adjustment import AdjustedSubmap
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan
from jaxslam.mapping.local_mapping import LocalMapping, NewKeyframe
from jaxslam.runtime.worker import ThreadWorker
from jaxslam.sensors.frame import Frame
from jaxslam.slam import map_adjuster
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.trajectory import write_tum

HERE = Path(__file__).resolve()
FOLDERS = f"{HERE.parents[2] / 'helpers'},{HERE.parent}"

FRAMES = 72
INLINE, LIVE = (Config(track=TRACK, run=RunConfig(deterministic=inline)) for inline in (True, False))
KINDS = pytest.mark.parametrize("config", [INLINE, LIVE], ids=["inline", "live"])


@functools.cache
def _source() -> SyntheticDataset:
    """Half as many frames a second as usual: more keyframes for the time."""
    return SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=FRAMES, people=0, path="loop", fps=15))


@functools.cache
def _frames() -> tuple[Frame, ...]:
    return tuple(_source()[index] for index in range(FRAMES))


def recording() -> Clip:
    return Clip(_source(), _frames())


def new_slam(config: Config = INLINE) -> Slam:
    slam = Slam(recording().camera, config)
    slam.warm_up()
    return slam


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("jaxslam-")]


def keyframe_frames() -> list[int]:
    """Which frames are kept, in a deterministic run."""
    with new_slam() as slam:
        return [index for index, frame in enumerate(_frames()) if slam.track(frame).is_keyframe]


class WrongError(Exception):
    """What goes wrong in these tests."""


class TestDeterminism:
    @pytest.mark.slow
    def test_two_runs_and_another_process(self, tmp_path: Path) -> None:
        """Trajectory and map, to the byte."""
        script = (
            "import sys; sys.path[:0] = sys.argv[1].split(',')\n"
            "import jax; jax.config.update('jax_numpy_dtype_promotion', 'strict')\n"
            "jax.config.update('jax_numpy_rank_promotion', 'raise')\n"
            "from pathlib import Path; import test_back_end\n"
            "test_back_end.write_run(Path(sys.argv[2]))\n"
        )
        for name in ("one", "two"):
            (tmp_path / name).mkdir()
            write_run(tmp_path / name)
        (tmp_path / "other").mkdir()
        arguments = [sys.executable, "-c", script, FOLDERS, str(tmp_path / "other")]
        subprocess.run(arguments, check=True, timeout=300)
        for file in ("trajectory", "map"):
            first = (tmp_path / "one" / file).read_bytes()
            assert (tmp_path / "two" / file).read_bytes() == first, file
            assert (tmp_path / "other" / file).read_bytes() == first, file

    @pytest.mark.slow
    def test_threads_give_much_the_same(self) -> None:
        """Not the same bytes, but the same places."""
        tracks = []
        for config in (INLINE, LIVE):
            with new_slam(config) as slam:
                slam.run(recording())
                tracks.append(slam.trajectory.T_world_cam)
                assert problems(slam.map) == []
                assert len(slam.map.ids) >= 4
        assert np.linalg.norm(tracks[0][:, 4:] - tracks[1][:, 4:], axis=1).max() < 0.1


def write_run(folder: Path) -> None:
    """The trajectory and the map of a deterministic run."""
    with new_slam() as slam:
        slam.run(recording())
        assert len(slam.map.ids) >= 4
        write_tum(folder / "trajectory", slam.trajectory)
        slam.save(folder / "map")


class TestCompiling:
    @pytest.mark.slow
    @pytest.mark.parametrize("config", [INLINE, LIVE], ids=["inline", "live"])
    def test_nothing_while_frames_come(self, compiled: list[str], config: Config) -> None:
        """Not for the work of mapping, a loss and a place recognized, corrections and recalls."""
        jax.clear_caches()
        with new_slam(config) as slam:
            compiled.clear()
            black = Frame(0, np.zeros((HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT, WIDTH), np.float32))
            order = [*_frames(), black, black, *_frames()[40:50]]
            statuses = []
            for index, frame in enumerate(order):
                statuses.append(slam.track(dataclasses.replace(frame, timestamp_ns=index * 66_666_666)).status)
                if config is LIVE:
                    time.sleep(0.02)  # so that mapping keeps up
            slam.finish()
            assert TrackStatus.RELOCALIZED in statuses
            assert len(slam.map.ids) >= 4
            assert compiled == []


class TestClose:
    @pytest.mark.parametrize("count", [0, 1, 40])
    def test_at_any_moment(self, count: int) -> None:
        slam = new_slam(LIVE)
        for frame in _frames()[:count]:
            slam.track(frame)
        closes_in_time(slam)
        assert threads() == []

    @pytest.mark.parametrize(
        ("owner", "method"),
        [
            (LocalMapping, "add"),
            pytest.param(LoopClosing, "look", marks=pytest.mark.slow),
            pytest.param(LocalMapping, "close_loop", marks=pytest.mark.slow),
        ],
    )
    def test_whatever_it_does(self, monkeypatch: pytest.MonkeyPatch, owner: type, method: str) -> None:
        """It adjusts, looks for a loop, or closes one, for five seconds."""
        begun, release = threading.Event(), threading.Event()

        def slow(self: Any, *arguments: Any) -> Any:
            begun.set()
            release.wait(5)
            raise WrongError("after the end")

        monkeypatch.setattr(owner, method, slow)
        if method == "close_loop":
            monkeypatch.setattr(LoopClosing, "look", lambda self, slam_map, keyframe_id: loop_at(slam_map, keyframe_id))
        slam = new_slam(LIVE)
        while not begun.is_set():
            for frame in _frames():
                slam.track(frame)
            slam.reset() if not begun.wait(0.5) else None
        closes_in_time(slam)
        closes_in_time(slam)  # again
        release.set()

    def test_both_threads_at_work(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Two seconds for both, not for each."""
        begun, release = [threading.Event(), threading.Event()], threading.Event()
        add = LocalMapping.add

        def slow_add(self: LocalMapping, new: NewKeyframe) -> Map:
            if new.id == 1:
                begun[0].set()
                release.wait(10)
            return add(self, new)

        def slow_look(self: LoopClosing, slam_map: Map, keyframe_id: int) -> None:
            begun[1].set()
            release.wait(10)

        monkeypatch.setattr(LocalMapping, "add", slow_add)
        monkeypatch.setattr(LoopClosing, "look", slow_look)
        slam = new_slam(LIVE)
        for frame in _frames():
            slam.track(frame)
            time.sleep(0.01)
        assert all(event.wait(10) for event in begun)
        closes_in_time(slam)
        release.set()

    @KINDS
    def test_nothing_is_tracked_after_it(self, config: Config, tmp_path: Path) -> None:
        """What was done can be read and saved, also twice closed; a reset begins anew."""
        slam = new_slam(config)
        for frame in _frames()[:40]:
            slam.track(frame)
        slam.close()
        slam.close()
        with pytest.raises(RuntimeError, match=r"the tracker is closed; Slam\.reset\(\) begins anew"):
            slam.track(_frames()[40])
        slam.save(tmp_path / "map")
        assert len(slam.trajectory) == 40
        slam.reset()
        assert slam.track(_frames()[0]).status is TrackStatus.STARTED
        slam.close()
        assert threads() == []

    @pytest.mark.slow
    def test_dropped_without_it(self) -> None:
        """The interpreter ends in time, and well, though mapping is at work."""
        script = (
            "import sys; sys.path[:0] = sys.argv[1].split(',')\n"
            "import test_back_end as t\n"
            "slam = t.new_slam(t.LIVE)\n"
            "for frame in t._frames()[:48]: slam.track(frame)\n"
            "print(len(t.threads()), flush=True)\n"
        )
        arguments = [sys.executable, "-c", script, FOLDERS]
        with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert int(process.stdout.readline()) >= 1
            began = time.monotonic()
            assert process.wait(timeout=60) == 0
        assert time.monotonic() - began < 4  # two for the threads; the rest is JAX's


def closes_in_time(slam: Slam) -> None:
    began = time.monotonic()
    slam.close()
    assert time.monotonic() - began < 2.0


def loop_at(slam_map: Map, keyframe_id: int) -> LoopClosure | None:
    """A loop from the first keyframe that asks for no change."""
    if keyframe_id == 0:
        return None
    relative = between(slam_map.pose(0), slam_map.pose(keyframe_id))
    return LoopClosure(0, keyframe_id, relative, 1e4 * np.eye(6), slam_map.ids, slam_map.T_world_cam)


class TestGlobalAdjustment:
    @pytest.mark.slow
    def test_follows_a_loop_and_ends_for_a_newer_one(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of two loops close to each other, the map after the second one counts; the tracker moves along with it."""
        second, third = keyframe_frames()[1:3]
        given, taken = self.watched(monkeypatch)
        monkeypatch.setattr(
            LoopClosing, "look", lambda self, slam_map, number: loop_at(slam_map, number) if number in (1, 2) else None
        )
        with new_slam() as slam:
            *_, before = [slam.track(frame) for frame in _frames()[: third + 20]]
            assert third - second < 10 * INLINE.mapping.latency_frames
            slam.finish()
            assert slam.loops_closed == 2
            assert [len(slam_map.loops.target) for slam_map in given] == [1, 2]
            assert len(taken) == 1
            there = np.isin(taken[0].keyframes, slam.map.ids)
            poses = np.array([slam.map.pose(int(number)) for number in taken[0].keyframes[there]])
            np.testing.assert_allclose(poses, taken[0].T_world_cam[there], atol=0.02)  # local adjustment came after it
            truth = recording().ground_truth
            assert truth is not None
            moved = between(truth.T_world_cam[third + 19], truth.T_world_cam[third + 20])
            last = slam.track(_frames()[third + 20])
            seen = between(compose(last.correction, before.T_world_cam), last.T_world_cam)
            assert np.linalg.norm(seen[4:] - moved[4:]) < 0.01
            assert problems(slam.map) == []

    def test_on_request_and_not_without_the_setting(self, monkeypatch: pytest.MonkeyPatch) -> None:
        given, taken = self.watched(monkeypatch)
        monkeypatch.setattr(LoopClosing, "look", lambda self, slam_map, number: loop_at(slam_map, number))
        without = dataclasses.replace(INLINE, mapping=MappingConfig(global_adjustment=False))
        with new_slam(without) as slam:
            for frame in _frames()[:50]:
                slam.track(frame)
            slam.finish()
            assert slam.loops_closed >= 1
            assert given == taken == []
            slam.adjust_map()
            assert len(given) == len(taken) == 1
            assert taken[0].cost < taken[0].initial_cost
            np.testing.assert_allclose(slam.map.T_world_cam[1:], taken[0].T_world_cam[1:], atol=1e-12)
            whole = slam.map
        with pytest.raises(RuntimeError, match="is closed"):
            slam.adjust_map()
        with Slam(recording().camera, INLINE, slam_map=whole) as loaded:  # and without a frame, or a warm-up
            loaded.adjust_map()
            assert taken[1].initial_cost <= 1.001 * taken[0].cost  # it goes on from there, the tree as it is now
        localizer = Slam(recording().camera, INLINE, slam_map=whole, localize_only=True)
        with localizer, pytest.raises(RuntimeError, match="stays as it is with localize_only"):
            localizer.adjust_map()

    def test_ends_when_the_tracker_is_closed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        begun, ended = threading.Event(), threading.Event()

        def endless(slam_map: Map, submap: int, plan: Any, is_interrupted: Callable[[], bool]) -> None:
            begun.set()
            while not is_interrupted():
                time.sleep(0.001)
            ended.set()

        monkeypatch.setattr("jaxslam.slam.map_adjuster.adjust_submap", endless)
        monkeypatch.setattr(LoopClosing, "look", lambda self, slam_map, number: loop_at(slam_map, number))
        slam, last = new_slam(LIVE), _frames()[-1]
        since_s = time.monotonic()
        # Results of threads are taken as frames come, and mapping has a low priority: beside three other processes on
        # one core, the loop came after 84 to 133 frames. Until then the camera rests at the last one.
        at_rest = (
            dataclasses.replace(last, timestamp_ns=last.timestamp_ns + number * 50_000_000)
            for number in itertools.count(1)
        )
        for frame in itertools.chain(_frames(), at_rest):
            slam.track(frame)
            time.sleep(0.01)
            if begun.is_set() or time.monotonic() - since_s > 300:
                break
        assert begun.is_set()
        closes_in_time(slam)
        assert ended.wait(1)
        assert threads() == []

    def test_waits_while_a_frame_is_tracked(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Before each chunk of points; a newer job ends it all the same."""
        asked, answers = threading.Event(), []

        def adjust(slam_map: Map, submap: int, plan: Any, is_interrupted: Callable[[], bool]) -> None:
            asked.set()
            answers.append(is_interrupted())

        monkeypatch.setattr(map_adjuster, "adjust_submap", adjust)
        monkeypatch.setattr(map_adjuster, "_PATIENCE_S", 60.0)
        make = lambda work: ThreadWorker(work, "jaxslam-adjustment")
        adjuster = map_adjuster.MapAdjuster(AdjustPlan(), make, in_turn=False)
        for is_newer in (False, True):
            asked.clear()
            adjuster.frame_begun()
            adjuster.worker.submit(adjuster.next_job(empty_map(recording().camera), [0]), 0)
            assert asked.wait(10)
            assert len(answers) == is_newer, "did not wait"
            if is_newer:
                adjuster.interrupt()
            adjuster.frame_ended()
            adjuster.worker.flush()
        adjuster.worker.close()
        assert answers == [False, True]

    def watched(self, monkeypatch: pytest.MonkeyPatch) -> tuple[list[Map], list[AdjustedSubmap]]:
        """The maps that are adjusted, and the results that are taken over."""
        given: list[Map] = []
        taken: list[AdjustedSubmap] = []
        adjust, take = map_adjuster.adjust_submap, LocalMapping.take_adjusted
        monkeypatch.setattr(
            map_adjuster, "adjust_submap", lambda slam_map, *others: given.append(slam_map) or adjust(slam_map, *others)
        )
        monkeypatch.setattr(
            LocalMapping, "take_adjusted", lambda self, submap: taken.append(submap) or take(self, submap)
        )
        return given, taken


class TestErrors:
    @KINDS
    @pytest.mark.parametrize("failing", [{0}, {1}, {1, 2}])
    def test_in_mapping(self, monkeypatch: pytest.MonkeyPatch, config: Config, failing: set[int]) -> None:
        """Each reaches the caller once, and the map goes on: also if its very first keyframe went wrong."""
        add = LocalMapping.add

        def wrong(self: LocalMapping, new: NewKeyframe) -> Map:
            slam_map = add(self, new)
            if new.id in failing:
                raise WrongError(f"keyframe {new.id}")
            return slam_map

        monkeypatch.setattr(LocalMapping, "add", wrong)
        with new_slam(config) as slam:
            messages = track_through(slam)
            assert sorted(messages) == [f"keyframe {number}" for number in sorted(failing)]
            assert len(slam.trajectory) == FRAMES
            assert slam.map.next_keyframe >= 4
            assert slam.map.ids.tolist()[:3] == [0, 1, 2]
            assert problems(slam.map) == []
            truth = recording().source.ground_truth.T_world_cam
            apart = between(
                between(slam.trajectory.T_world_cam[:1], slam.trajectory.T_world_cam), between(truth[:1], truth)
            )
            assert np.linalg.norm(apart[:, 4:], axis=1).max() < 0.15

    @KINDS
    def test_in_looking_for_loops(self, monkeypatch: pytest.MonkeyPatch, config: Config) -> None:
        look = LoopClosing.look

        def wrong(self: LoopClosing, slam_map: Map, keyframe_id: int) -> LoopClosure | None:
            found = look(self, slam_map, keyframe_id)
            if keyframe_id == 1:
                raise WrongError("loop 1")
            return found

        monkeypatch.setattr(LoopClosing, "look", wrong)
        with new_slam(config) as slam:
            assert track_through(slam) == ["loop 1"]
            assert len(slam.trajectory) == FRAMES

    @KINDS
    def test_while_finishing(self, monkeypatch: pytest.MonkeyPatch, config: Config) -> None:
        """After an error one can finish again, and track on."""
        monkeypatch.setattr(LoopClosing, "look", lambda self, slam_map, keyframe_id: _raise(f"loop {keyframe_id}"))
        with new_slam(config) as slam:
            slam.track(_frames()[0])
            with pytest.raises(WrongError, match="loop 0"):
                slam.finish()
            slam.finish()
            assert slam.map.ids.tolist() == [0]
            assert slam.track(_frames()[1]).status is TrackStatus.OK

    def test_in_closing_a_loop(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(LoopClosing, "look", lambda self, slam_map, keyframe_id: loop_at(slam_map, keyframe_id))
        monkeypatch.setattr(LocalMapping, "close_loop", lambda self, loop: _raise("close"))
        with new_slam() as slam:
            assert set(track_through(slam)) == {"close"}
            assert slam.loops_closed == 0
            assert len(slam.map.ids) >= 4
            assert problems(slam.map) == []


def _raise(message: str) -> Any:
    raise WrongError(message)


def track_through(slam: Slam) -> list[str]:
    """Track all frames, each again after an error, and finish; gives what went wrong."""
    messages: list[str] = []

    def patiently(action: Callable[[], Any]) -> None:
        done = False
        while not done:
            try:
                action()
                done = True
            except WrongError as error:
                messages.append(str(error))

    for frame in _frames():
        patiently(functools.partial(slam.track, frame))
    patiently(slam.finish)
    return messages


class TestFinish:
    def test_hands_over_loops_that_are_on_their_way(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The map of a keyframe has come, what was looked for in it has not: the loop is closed all the same."""
        monkeypatch.setattr(LoopClosing, "look", lambda self, slam_map, keyframe_id: loop_at(slam_map, keyframe_id))
        last = keyframe_frames()[1]
        with new_slam() as slam:
            for frame in _frames()[: last + INLINE.mapping.latency_frames + 2]:
                slam.track(frame)
            assert slam.map.ids.tolist() == [0, 1]
            assert slam.loops_closed == 0
            slam.finish()
            assert slam.loops_closed == 1
            assert slam.map.loops.target.tolist() == [1]

    def test_its_correction_is_told_with_the_next_frame(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A jump is told from a motion, also if the map was waited for."""
        monkeypatch.setattr(
            "jaxslam.mapping.local_bundle_adjustment._MIN_KEYFRAMES", 2
        )  # so that the second one corrects
        second = keyframe_frames()[1]
        with new_slam() as slam:
            before = [slam.track(frame) for frame in _frames()[: second + 1]][-1]
            slam.finish()
            after = slam.map.pose(1)
            told = slam.track(_frames()[second + 1]).correction
        moved = between(before.T_world_cam, after)
        assert np.linalg.norm(moved[4:]) > 1e-3  # the map has moved the keyframe
        from_told = between(before.T_world_cam, compose(told, before.T_world_cam))
        np.testing.assert_allclose(from_told[4:], moved[4:], atol=1e-5)
        np.testing.assert_allclose(angle(between(from_told, moved)), 0, atol=1e-5)

    def test_twice(self) -> None:
        with new_slam() as slam:
            for frame in _frames()[:40]:
                slam.track(frame)
            slam.finish()
            first = slam.map
            slam.finish()
            assert slam.map is first
