"""Executed operations and self times by function of the source, from XLA's own trace of the tracker."""

import re
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jax.profiler import ProfileData, ProfileOptions

from jaxslam.benchmark.compiling.hlo_text import NO_FUNCTION, Instruction
from jaxslam.benchmark.compiling.parts import Scene
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.errors import BenchmarkError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameMemory
from jaxslam.slam.tracker import MapWishes

NUM_WARM, NUM_TRACED = 10, 20
"""Numbers of frames that are tracked before the trace begins, and in it."""
_CLONE = re.compile(r"\.clone(\.\d+)?$")
"""XLA runs some instructions as copies of those in the text."""


@dataclass(frozen=True)
class Spent:
    """Cost of a function per frame.

    Attributes:
        executed: Number of operations executed per frame.
        self_ms: Time in these operations per frame, without the operations that they call; milliseconds. The trace
            itself takes part of it.
    """

    executed: float
    self_ms: float


@dataclass(frozen=True)
class _Event:
    """An executed operation.

    Attributes:
        begin_ns: Beginning on the clock of the trace, nanoseconds.
        length_ns: Length, with the operations inside it, nanoseconds.
        name: Name of the instruction.
        module: Name of the program.
    """

    begin_ns: float
    length_ns: float
    name: str
    module: str


def room_through_lens(camera: Camera, count: int) -> list[Frame]:
    """Render frames of a room with two people, as a camera with this lens sees them.

    Args:
        camera: Camera with or without distortion; the shutter opens for all rows at once.
        count: Number of frames.
    """
    of_lens = SyntheticConfig(
        frames=count,
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
    )
    room = SyntheticDataset(of_lens)
    pinhole = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(np.float32)
    ideal = cv2.undistortPoints(pixels.reshape(-1, 1, 2), pinhole, np.array(camera.distortion), P=pinhole)
    column, row = np.moveaxis(ideal.reshape(pixels.shape).astype(np.float32), -1, 0)
    frames = []
    for frame in map(room.__getitem__, range(count)):
        assert frame.depth_m is not None
        image = cv2.remap(frame.image, column, row, cv2.INTER_LINEAR)
        depth_m = cv2.remap(frame.depth_m, column, row, cv2.INTER_NEAREST)
        frames.append(replace(frame, image=image, depth_m=depth_m))
    return frames


def trace_tracker(
    scene: Scene, frames: Sequence[Frame], programs: Mapping[str, Mapping[str, Instruction]]
) -> dict[str, dict[str, Spent]]:
    """Track frames, record XLA's trace of the last ones, and sum it by function.

    Args:
        scene: Camera and settings.
        frames: Frames in the order of time, more than `NUM_WARM`.
        programs: Instructions of the programs of interest by the names of their modules.

    Returns:
        By module and function, what it cost per frame.

    Raises:
        BenchmarkError: If XLA's trace has no operation of these programs.
    """
    tracker = scene.tracker()
    memory = FrameMemory(scene.camera.height, scene.camera.width, pairs=scene.camera.is_stereo)
    stamps = [frame.timestamp_ns for frame in frames]
    steps_s = [1 / scene.camera.fps, *(1e-9 * (after - before) for before, after in pairwise(stamps))]

    def track(some: slice) -> None:
        for frame, step_s in zip(frames[some], steps_s[some], strict=True):
            arrays = memory.hold(frame, step_s)
            tracker.advance(arrays, tracker.follow(arrays), MapWishes())

    track(slice(NUM_WARM))
    options = ProfileOptions()
    options.python_tracer_level, options.host_tracer_level = 0, 3
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            track(slice(NUM_WARM, None))
        (file,) = Path(folder).glob("plugins/profile/*/*.xplane.pb")
        return _sums(ProfileData.from_file(str(file)), programs, len(frames) - NUM_WARM)


def _sums(
    profile: Any, programs: Mapping[str, Mapping[str, Instruction]], num_frames: int
) -> dict[str, dict[str, Spent]]:
    """Sum the operations of a trace by program and function."""
    executed: defaultdict[tuple[str, str], int] = defaultdict(int)
    spent_ns: defaultdict[tuple[str, str], float] = defaultdict(float)
    for event, own_ns in _events(profile):
        if event.module in programs:
            instruction = programs[event.module].get(_CLONE.sub("", event.name))
            key = event.module, NO_FUNCTION if instruction is None else instruction.function
            executed[key] += 1
            spent_ns[key] += own_ns
    if not executed:
        raise BenchmarkError(f"XLA's trace: expected operations of {', '.join(programs)}, got none")
    found: dict[str, dict[str, Spent]] = {module: {} for module in programs}
    for (module, function), number in executed.items():
        found[module][function] = Spent(number / num_frames, 1e-6 * spent_ns[module, function] / num_frames)
    return found


def _events(profile: Any) -> Iterator[tuple[_Event, float]]:
    """Give the operations of a trace, each with its time without those inside it, nanoseconds."""
    for plane in profile.planes:
        for line in plane.lines:
            events = []
            for event in line.events:
                stats = dict(event.stats)
                if "hlo_op" in stats:
                    events.append(_Event(event.start_ns, event.duration_ns, event.name, str(stats.get("hlo_module"))))
            events.sort(key=lambda event: (event.begin_ns, -event.length_ns))
            yield from zip(events, _own_ns(events), strict=True)


def _own_ns(events: Sequence[_Event]) -> list[float]:
    """Return the time of each event without those inside it; outer events come before inner ones."""
    own_ns, around = [event.length_ns for event in events], list[int]()
    for index, event in enumerate(events):
        while around and events[around[-1]].begin_ns + events[around[-1]].length_ns <= event.begin_ns:
            around.pop()
        if around:
            own_ns[around[-1]] -= event.length_ns
        around.append(index)
    return own_ns
