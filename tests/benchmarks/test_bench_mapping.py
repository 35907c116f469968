"""Local mapping stage by stage, and how time and memory of a keyframe grow with the map.

`JAXSLAM_DATA=... pytest -m benchmark -n 0 tests/benchmarks/test_bench_mapping.py -s`
"""

import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxslam.benchmark.timing import pinned_to_one_core
from jaxslam.config.schema import Config
from jaxslam.datasets import open_dataset
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map
from jaxslam.mapping import local_mapping as module
from jaxslam.mapping.local_mapping import LocalMapping, NewKeyframe, mapping_plan
from jaxslam.sensors.sensor_model import sensor_model
from jaxslam.slam.slam import Slam

pytestmark = pytest.mark.benchmark

KEYFRAMES = 1000
STAGES = ("features_of", "_part", "find_points", "with_triangulated", "fuse_duplicates", "without_unconfirmed")
STAGES += ("adjust_around", "without_redundant", "merge_back")
STEPS = ("_with_keyframe", "_with_tracks", "_with_found_points", "_with_new_points", "_fused")
FAR_M = 50.0
"""How far each repetition is from the one before: nothing of one is in view of another."""


@pytest.fixture(scope="module")
def recorded(data_dir: Path) -> tuple[Slam, list[NewKeyframe]]:
    """The keyframes of a recording, as the tracker hands them over."""
    jobs: list[NewKeyframe] = []
    add = LocalMapping.add

    def noted(self: LocalMapping, new: NewKeyframe) -> Map:
        jobs.append(new._replace(frame=type(new.frame)(*jax.tree.map(np.array, tuple(new.frame)))))
        return add(self, new)

    dataset = open_dataset(data_dir / "tum" / "rgbd_dataset_freiburg1_rpy_excerpt")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LocalMapping, "add", noted)
        slam = Slam(dataset.camera, Config())
        for frame in range(len(dataset)):
            slam.track(dataset[frame])
        slam.finish()
    return slam, jobs


def repeated(jobs: list[NewKeyframe], number: int) -> NewKeyframe:
    """Keyframe `number` of the recording played again and again, each time elsewhere."""
    turn, index = divmod(number, len(jobs))
    job, offset = jobs[index], turn * len(jobs)
    parent, pose = job.parent + offset, job.T_parent_keyframe
    if job.parent == NONE:
        parent = offset - 1 if turn else NONE
        pose = np.array([1.0, 0, 0, 0, FAR_M, 0, 0]) if turn else pose
    own = job.tracks.id >= 0  # the others are points reloaded from that map
    tracks = job.tracks._replace(
        id=np.where(own, job.tracks.id + 10**6 * turn, job.tracks.id), weight=np.where(own, job.tracks.weight, 0)
    )
    time_ns = job.timestamp_ns + turn * 10**12
    return job._replace(id=number, timestamp_ns=time_ns, parent=parent, T_parent_keyframe=pose, submap=0, tracks=tracks)


def fresh(slam: Slam, jobs: list[NewKeyframe]) -> LocalMapping:
    plan = mapping_plan(slam.camera, slam.config)
    mapping = LocalMapping(slam.camera, sensor_model(slam.camera, slam.config.track), plan)
    mapping.compile(jobs[0].frame, len(jobs[0].tracks.id))
    return mapping


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def timed(patch: pytest.MonkeyPatch, owner: Any, name: str, times: dict[str, list[float]]) -> None:
    function: Callable[..., Any] = getattr(owner, name)

    def measured(*args: Any, **kwargs: Any) -> Any:
        began = time.perf_counter()
        result = function(*args, **kwargs)
        times[name].append(1e3 * (time.perf_counter() - began))
        return result

    patch.setattr(owner, name, measured)


def test_stages(recorded, monkeypatch):
    """Of real keyframes, some stages are part of others."""
    slam, jobs = recorded
    times: dict[str, list[float]] = defaultdict(list)
    for name in STAGES:
        timed(monkeypatch, module, name, times)
    for name in STEPS:
        timed(monkeypatch, LocalMapping, name, times)
    mapping, whole = fresh(slam, jobs), []
    with pinned_to_one_core():
        for job in jobs:
            began = time.perf_counter()
            mapping.add(job)
            whole.append(1e3 * (time.perf_counter() - began))
    print(f"\nadd: median {np.median(whole):.1f} ms, max {max(whole):.1f} ms, of {len(jobs)} keyframes")
    for name, took in times.items():
        print(f"  {name}: {sum(took) / len(whole):.1f} ms a keyframe")
    assert np.median(whole) < 400


def test_growth(recorded):
    """Time and memory of a keyframe as the map grows to a thousand."""
    slam, jobs = recorded
    mapping, took, memory = fresh(slam, jobs), [], {}
    for number in range(KEYFRAMES):
        began = time.process_time()
        mapping.add(repeated(jobs, number))
        took.append(1e3 * (time.process_time() - began))
        memory[number + 1] = resident_mb()
        if (number + 1) % 100 == 0 or number == 49:
            recent = np.median(took[max(0, number - 49) : number + 1])
            print(f"\n{number + 1}: {recent:.1f} ms of processor time, {memory[number + 1]:.0f} MB resident", end="")
    slam_map = mapping.map
    early, late = np.median(took[20:70]), np.median(took[-50:])
    a_keyframe = (memory[KEYFRAMES] - memory[100]) / (KEYFRAMES - 100)
    size = lambda record: sum(array.nbytes for array in record if isinstance(array, np.ndarray)) / KEYFRAMES / 1e3
    print(f"\nat 50 {early:.1f} ms, at {KEYFRAMES} {late:.1f} ms: {late / early:.2f} times", end="; ")
    print(f"{a_keyframe:.2f} MB a keyframe")
    print(
        f"kB a keyframe: points {size(slam_map.points):.0f}, observations {size(slam_map.observations):.0f}, ", end=""
    )
    print(f"features {np.mean([1e3 * size(frame.features) for frame in slam_map.keyframes]):.0f}, ", end="")
    print(f"image {np.mean([len(frame.image_file) / 1e3 for frame in slam_map.keyframes]):.0f}")
    assert late < 2 * early
    assert a_keyframe < 1.0
