"""Throughput of tracking many clips at once: `vmap` of `track_step` compared with the same step clip by clip."""

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from jaxslam.config.schema import TrackConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.machine import peak_rss_mb
from jaxslam.runtime.threads import threads
from jaxslam.sensors.frame_arrays import FrameArrays, stack_frames
from jaxslam.tracking.batch import TrackedClips, track_clips
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackParams, TrackPlan, TrackStatus
from jaxslam.tracking.step import track_step
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory

DIFFERENT = 8
"""Rooms that are rendered; of more clips some are the same."""
_PATHS = ("xyz", "rpy", "halfsphere", "loop")
_MAX_PEOPLE = 2
_AT_ONCE = 4
"""Clips a program where programs share the cores; 2 or 8 are as fast."""


@dataclass(frozen=True, eq=False)
class Room:
    """A clip with its truth.

    Attributes:
        frames: Frames of the clip.
        truth: True poses of the camera.
    """

    frames: FrameArrays
    truth: Trajectory


@dataclass(frozen=True)
class Way:
    """A way to track clips: so many in one program, so many programs at a time."""

    at_once: int
    threads: int

    @property
    def text(self) -> str:
        """Whether it is one program, or several."""
        return "one program" if self.threads == 1 else f"{self.threads} threads of {self.at_once}"


@dataclass(frozen=True, eq=False)
class Task:
    """Clips to track, and the settings of the tracker.

    Attributes:
        rooms: Clips of equal image size and length.
        params: Camera and thresholds of the tracker.
        plan: Array capacities of the tracker.
    """

    rooms: Sequence[Room]
    params: TrackParams
    plan: TrackPlan

    def clips(self, count: int) -> list[FrameArrays]:
        """Return this many clips, from the rooms in turn."""
        return [self.rooms[index % len(self.rooms)].frames for index in range(count)]


@dataclass(frozen=True)
class _Times:
    """Times of a call, one per round."""

    wall_s: list[float]
    processor_s: list[float]

    def per_s(self, frames: int) -> float:
        """Frames a second, the median of the rounds."""
        return frames / statistics.median(self.wall_s)

    def cores(self) -> float:
        """Average number of cores that computed."""
        return sum(self.processor_s) / sum(self.wall_s)


def make_task(count: int, frames: int, width: int, height: int) -> Task:
    """Render as many different clips, with up to two people, and settings for images of this size.

    Raises:
        ConfigError: If there are no such images.
    """
    config = partial(SyntheticConfig, frames=frames, width=width, height=height)
    datasets = [
        SyntheticDataset(config(seed=seed, path=_PATHS[seed % len(_PATHS)], people=seed % (_MAX_PEOPLE + 1)))
        for seed in range(count)
    ]
    rooms = [Room(stack_frames([room[index] for index in range(frames)]), room.ground_truth) for room in datasets]
    settings = _settings(width)
    return Task(rooms, track_params(datasets[0].camera, settings), track_plan(settings))


def ways(count: int) -> list[Way]:
    """List the ways to track a number of clips: all in one program, and split over the threads of XLA on a CPU."""
    found, cores = [Way(count, 1)], threads()
    if jax.default_backend() == "cpu" and cores > 1 and count >= 2 * cores:
        found.append(Way(min(_AT_ONCE, count // cores), cores))
    return found


def measure(task: Task, count: int, rounds: int) -> list[dict[str, Any]]:
    """Track clips at once and one by one, in turn.

    The loop takes each different clip once: what one costs it does not depend on how many there are.

    Args:
        task: Clips and settings.
        count: Number of clips.
        rounds: Number of timings of each way.

    Returns:
        A row of figures for each of `ways(count)`.
    """
    clips, alone = task.clips(count), task.clips(min(count, len(task.rooms)))
    by_itself = partial(loop, alone, task)
    calls = {way: partial(_batch, clips, task, way) for way in ways(count)}
    one_frame = [jax.tree.map(lambda array: array[:1], clip) for clip in clips]
    compile_s = {way: _seconds(partial(_batch, one_frame, task, way)) for way in calls}
    found = {way: call() for way, call in calls.items()}
    expected = by_itself()
    times = _in_turn([by_itself, *calls.values()], rounds)
    frames = clips[0].image.shape[0]
    loop_per_s = times[0].per_s(len(alone) * frames)
    rows = []
    for way, timed in zip(calls, times[1:], strict=True):
        per_s = timed.per_s(count * frames)
        rows.append(
            {
                "clips": count,
                "different": len(alone),
                "way": way.text,
                "at_once": way.at_once,
                "threads": way.threads,
                "compile_s": compile_s[way],
                "frames_per_s": per_s,
                "cores": timed.cores(),
                "frames_per_s_per_core": per_s / timed.cores(),
                "loop_frames_per_s": loop_per_s,
                "loop_frames_per_s_per_core": loop_per_s / times[0].cores(),
                "ratio_to_loop": per_s / loop_per_s,
                "peak_rss_mb": peak_rss_mb(),
                "peak_device_mb": _peak_device_mb(),
                **_accuracy(task, found[way], expected),
            }
        )
    return rows


def _settings(width: int) -> TrackConfig:
    """The default ones, with corners as close to each other as in an image of 640 pixels."""
    default = TrackConfig()
    return replace(default, cell_px=max(8, 2 * round(default.cell_px * width / 640 / 2)))


def _batch(clips: Sequence[FrameArrays], task: Task, way: Way) -> TrackedClips:
    return track_clips(clips, task.params, task.plan, at_once=way.at_once, threads=way.threads)


_step_alone = compiled(when="first use", static="plan", donate="state")(track_step)


def loop(clips: Iterable[FrameArrays], task: Task) -> TrackedClips:
    """Track clip by clip, frame by frame."""
    poses, statuses = [], []
    for clip in clips:
        num_frames, height, width = clip.image.shape
        state, found = init_state(height, width, task.plan), []
        for index in range(num_frames):
            frame = jax.tree.map(lambda array, index=index: array[index], clip)
            state, output = _step_alone(state, frame, task.params, plan=task.plan)
            found.append((output.T_world_cam.wxyz_xyz, output.status))
            jax.block_until_ready(found[-2:-1])  # as in a batch
        of_clip = jax.device_get(found)
        poses.append([pose for pose, _ in of_clip])
        statuses.append([status for _, status in of_clip])
    return TrackedClips(np.array(poses), np.array(statuses))


def _seconds(call: Callable[[], Any]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def _in_turn(calls: Sequence[Callable[[], Any]], rounds: int) -> list[_Times]:
    """Each once a round, so that what disturbs one disturbs the others."""
    times = [_Times([], []) for _ in calls]
    for _ in range(rounds):
        for call, timed in zip(calls, times, strict=True):
            began = time.process_time()
            timed.wall_s.append(_seconds(call))
            timed.processor_s.append(time.process_time() - began)
    return times


def _accuracy(task: Task, found: TrackedClips, expected: TrackedClips) -> dict[str, Any]:
    """Errors of the different clips, and how far each clip is from the one tracked alone."""
    errors, alone = (
        [_ate_m(poses, room) for poses, room in zip(clips.T_world_cam, task.rooms, strict=False)]
        for clips in (found, expected)
    )
    same = np.arange(len(found.status)) % len(expected.status)
    off = found.T_world_cam[:, :, 4:] - expected.T_world_cam[same][:, :, 4:]
    lost = found.status == TrackStatus.LOST
    return {
        "ate_rmse_m": statistics.median(errors),
        "ate_rmse_m_alone": statistics.median(alone),
        "ate_rmse_m_of_clips": errors,
        "tracked_percent": 100 * float(np.mean(~lost)),
        "off_alone_m": float(np.linalg.norm(off, axis=2).max()),
        "same_statuses": bool(np.array_equal(found.status, expected.status[same])),
    }


def _ate_m(poses: np.ndarray, room: Room) -> float:
    return evaluate(Trajectory(room.truth.timestamps_ns, poses), room.truth).ate_rmse_m


def _peak_device_mb() -> float | None:
    """Memory of the accelerator; `None` where it is the processor's or not known."""
    known = jax.local_devices()[0].memory_stats() or {}
    return known["peak_bytes_in_use"] / 1e6 if "peak_bytes_in_use" in known else None
