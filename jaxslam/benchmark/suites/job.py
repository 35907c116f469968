"""One run of a suite, in a process of its own: whatever it does to itself, the others and the report go on.

`python -m jaxslam.benchmark.suites.job FOLDER [--root ROOT] [--rooms ROOMS]` runs the one that is written in a
folder, as long as its input lasts.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.benchmark.process_ending import how_it_ended, last_words
from jaxslam.benchmark.reference_flow import flow_time_ms
from jaxslam.benchmark.suites.provenance import (
    camera_sha256,
    data_sha256,
    networks_sha256,
    sources_sha256,
    world_sha256,
)
from jaxslam.benchmark.suites.run_names import flattened, run_folder
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.config.loading import load_config, to_yaml
from jaxslam.config.schema import Config
from jaxslam.datasets import Associated, Dataset, Subset, imu_sheet, open_dataset
from jaxslam.datasets.catalog import find_recording
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, with_true_masks
from jaxslam.datasets.synthetic.cached_dataset import StoredRoom
from jaxslam.datasets.synthetic.sensor_noise import SensorConfig
from jaxslam.errors import BenchmarkError, JaxSlamError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.yaml_files import parse_yaml
from jaxslam.results.run_results import RunInfo, write_results
from jaxslam.runtime.compile_cache import enable_compile_cache
from jaxslam.runtime.threads import bound_threads
from jaxslam.semantics.from_config import preset_needs_network
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.relative_pose_log import RelativePoseLog
from jaxslam.slam.slam import Slam
from jaxslam.visualization.snapshots import RunPictures
from jaxslam.worlds.stored_world import StoredWorld

RESULT = "result.json"
"""The last file of a run to be written: where it is, the run is done."""
DONE, FAILED, NOT_RUN = "done", "failed", "not run"
"""The status of a run in its result: made to its end, ended by a problem, planned and not made."""
_JOB, _CONFIG, _CHECKSUM = "job.json", "config.yaml", "result_sha256"
_LAST_WORDS = 400


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        clip: Sequence to track.
        preset: Preset to track with.
        variant: Name of further settings; empty for none.
        settings: Settings `key=value`, in the order in which they are applied.
        seed: Seed of every random choice.
    """

    clip: Clip
    preset: str
    variant: str
    settings: tuple[str, ...]
    seed: int

    @property
    def label(self) -> str:
        """Preset and variant."""
        return f"{self.preset}@{self.variant}" if self.variant else self.preset

    @property
    def folder(self) -> Path:
        """Folder of its results, relative to the results of the suite."""
        return run_folder(self.clip.name, self.label, self.seed)

    @property
    def config(self) -> Config:
        """Every setting of it."""
        return load_config(self.preset, overrides=(*self.settings, f"run.seed={self.seed}"))

    def to_json(self) -> str:
        """Return the job as text, from which `of_json` makes an equal job."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def of_json(cls, text: str) -> "Job":
        """The job of which this is the text."""
        fields = json.loads(text)
        clip = fields.pop("clip")
        room = clip.pop("room")
        if room is not None:
            room = SyntheticConfig(**room | {"sensor": SensorConfig(**room["sensor"])})
        return cls(Clip(room=room, **clip), **fields | {"settings": tuple(fields["settings"])})


def opened(clip: Clip, root: Path | None, rooms: Path | None = None) -> tuple[Dataset, Path | None]:
    """Open the sequence of a job, and find its folder if it is a recording.

    Args:
        clip: Sequence to open.
        root: Folder in which recordings are looked for first.
        rooms: Folder in which rendered frames are kept; all are rendered before anything is timed. `None` to render
            them as they are asked for.

    Raises:
        BenchmarkError: If its recording is not on this machine, or of another sensor than it says.
    """
    folder = None
    if clip.room is not None and rooms is not None:
        dataset: Dataset = StoredRoom(clip.room, rooms / clip.name)
        dataset.render_all()
    elif clip.room is not None:
        dataset = SyntheticDataset(clip.room)
    elif clip.world:
        dataset = _world(clip)
    else:
        folder = find_recording(clip.recording, root)
        if folder is None:
            raise BenchmarkError(f"{clip.recording}: not on this machine; to get it: jaxslam data get {clip.recording}")
        dataset = open_dataset(folder, camera=clip.camera)
    taken_with = "stereo" if dataset.camera.is_stereo else "rgbd"
    if clip.sensor not in (None, taken_with):
        raise BenchmarkError(f"{clip.name}: sensor: expected {clip.sensor}, got a recording of {taken_with}")
    return (dataset if clip.whole else Subset(dataset, clip.start, clip.stop, clip.every)), folder


def _world(clip: Clip) -> StoredWorld:
    """The world of a clip, whose frames are in the user's cache before anything is timed.

    Raises:
        BenchmarkError: If it cannot be opened.
    """
    try:
        world = StoredWorld(clip.world)
    except JaxSlamError as error:
        raise BenchmarkError(f"{clip.name}: {error}") from None
    world.render_all(range(len(world))[clip.start : clip.stop : clip.every])
    return world


def stored(job: Job, out: Path) -> tuple[dict[str, Any], list[str]] | None:
    """The result of a job that has been run to its end, if there is one.

    Returns:
        Its figures, and what is different about the job now, in words: none if it has the settings and the sequence
        that it was run with, and nobody has changed the file.

    Raises:
        BenchmarkError: If the files of the run cannot be read.
    """
    folder = out / job.folder
    try:
        result = json.loads((folder / RESULT).read_text())
        clip = json.loads((folder / _JOB).read_text())["clip"]
        config = _read_config((folder / _CONFIG).read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, BenchmarkError) as problem:
        raise BenchmarkError(f"{folder}: expected the results of a run, got something unreadable: {problem}") from None
    different = _differences(clip, json.loads(job.to_json())["clip"])
    different += _differences(config, _read_config(to_yaml(job.config)))
    if _CHECKSUM not in result:
        different.append(f"{RESULT} is of an older jaxslam, which did not say what it depends on")
    elif result[_CHECKSUM] != _checksum(result):
        different.append(f"{RESULT} is not as the run wrote it")
    return result, different


def _read_config(text: str) -> dict[str, Any]:
    return parse_yaml(text, _CONFIG, BenchmarkError)


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    old, new = flattened(before), flattened(now)
    return [
        f"{key} was {old.get(key)}, is {new.get(key)}"
        for key in dict.fromkeys((*old, *new))
        if old.get(key) != new.get(key)
    ]


def _checksum(result: Mapping[str, Any]) -> str:
    """Hash of all of a result but the checksum itself."""
    content = {key: value for key, value in result.items() if key != _CHECKSUM}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def run_in_process(job: Job, out: Path, root: Path | None, rooms: Path | None = None) -> dict[str, Any]:
    """Run a job in a separate process.

    Args:
        job: Job to run.
        out: Folder of the suite's results.
        root: Folder in which recordings are looked for first.
        rooms: Folder in which rendered frames are kept for others of the suite.

    Returns:
        Its figures. If the process failed, `status` is `failed` and `problem` says how; that is kept in no file, so
        that the run is tried again.
    """
    folder = out / job.folder
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULT).unlink(missing_ok=True)
    write_atomically(folder / _JOB, job.to_json().encode(), BenchmarkError)
    command = [sys.executable, "-m", "jaxslam.benchmark.suites.job", str(folder)]
    for name, path in (("--root", root), ("--rooms", rooms)):
        command += [] if path is None else [name, str(path)]
    reading, writing = os.pipe()  # which closes if this process ends, however it does
    try:
        done = subprocess.run(command, stdin=reading, capture_output=True, text=True, errors="replace", check=False)
    finally:
        os.close(reading)
        os.close(writing)
    (folder / "log.txt").write_text(done.stdout + done.stderr)
    result = stored(job, out)
    if result is not None and not result[1] and done.returncode == 0:
        return result[0]
    (folder / RESULT).unlink(missing_ok=True)
    other = "; ".join(result[1]) if result is not None and done.returncode == 0 else ""
    return failed(job, f"it was run otherwise than planned: {other}" if other else _problem(done))


def failed(job: Job, problem: str) -> dict[str, Any]:
    """Make the result of a run that failed."""
    return about(job) | {"status": FAILED, "problem": problem}


def not_run(job: Job) -> dict[str, Any]:
    """Make the result of a planned run that has not been made."""
    return about(job) | {"status": NOT_RUN, "problem": None}


def run_here(folder: Path, root: Path | None, rooms: Path | None) -> None:
    """Run the job that is written in a folder; its results go there.

    Raises:
        JaxSlamError: If its recording is not there or not fit to be tracked, or a file cannot be written.
    """
    job, sources = Job.of_json((folder / _JOB).read_text()), sources_sha256()
    bound_threads(job.config.run.threads)
    enable_compile_cache()
    whole, recording = opened(job.clip, root, rooms)
    dataset, truth = with_true_masks(whole, job.config.semantics)
    flow_ms = flow_time_ms(dataset)
    pictures, poses = RunPictures(len(dataset)), RelativePoseLog()

    def watch(frame: Frame | None, result: FrameResult | Rejected) -> None:
        pictures(frame, result)
        poses(frame, result)

    slam = Slam(dataset.camera, job.config, detector=truth, imu=imu_sheet(dataset))
    slam.warm_up()
    began = time.perf_counter()
    with slam:
        records = slam.run(dataset, watch)
    info = RunInfo(dataset, job.preset, time.perf_counter() - began)
    summary, _ = write_results(folder, slam, records, info, pictures, poses.poses())
    times = summary["track_ms"]
    ratios = {} if flow_ms is None else {f"flow_ratio_{name}": round(times[name] / flow_ms, 4) for name in times or ()}
    result = about(job) | {
        "status": DONE,
        "problem": None,
        **summary,
        "images": _num_images(whole),
        "rate_hz": _rate_hz(dataset),
        "flow_ms": None if flow_ms is None else round(flow_ms, 4),
        **ratios,
        "sources_sha256": sources,
        "data_sha256": _data_sha256(job.clip, recording),
        "camera_sha256": camera_sha256(job.clip),
        "lacks_network": slam.without_network is not None and preset_needs_network(job.preset),
        "networks_sha256": networks_sha256(job.config.semantics),
        "config": dataclasses.asdict(job.config),
    }
    result |= {_CHECKSUM: _checksum(result)}
    write_atomically(folder / RESULT, (json.dumps(result, indent=2) + "\n").encode(), BenchmarkError)


def _data_sha256(clip: Clip, recording: Path | None) -> str | None:
    if clip.world:
        return world_sha256(clip.world)
    return None if recording is None else data_sha256(recording)


def _num_images(whole: Dataset) -> int:
    """Count the color images, or pairs, of the recording, including those without a depth image."""
    return len(whole) + (whole.unmatched.color if isinstance(whole, Associated) else 0)


def _rate_hz(dataset: Dataset) -> float:
    """Frames a second; that of the camera if there is one frame only."""
    steps_ns = np.diff(dataset.timestamps_ns)
    return round(1e9 / float(np.median(steps_ns)), 3) if len(steps_ns) else dataset.camera.fps


def about(job: Job) -> dict[str, Any]:
    """Return the part of a result that describes its job."""
    return {
        "sequence": job.clip.name,
        "label": job.label,
        "preset": job.preset,
        "variant": job.variant,
        "seed": job.seed,
    }


def _problem(done: "subprocess.CompletedProcess[str]") -> str:
    return f"{how_it_ended(done.returncode)}: {last_words(done.stderr)[-_LAST_WORDS:]}"


def _end_with_parent() -> None:
    """End when the input does: a suite that was killed must not go on writing where its successor writes."""

    def wait() -> None:
        while os.read(0, 1):  # not through `sys.stdin`, whose lock would be held when the process ends
            pass
        os._exit(1)

    threading.Thread(target=wait, name="jaxslam-parent", daemon=True).start()


def _main(arguments: Sequence[str]) -> None:
    _end_with_parent()
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--rooms", type=Path)
    chosen = parser.parse_args(arguments)
    try:
        run_here(chosen.folder, chosen.root, chosen.rooms)
    except JaxSlamError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    _main(sys.argv[1:])
