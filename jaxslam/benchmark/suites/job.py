"""One run of a suite, in a process of its own: whatever it does to itself, the others and the report go on.

`python -m jaxslam.benchmark.suites.job FOLDER [--root ROOT] [--rooms ROOMS] [--began SECONDS]` runs the one that is
written in a folder, as long as its input lasts.
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

import psutil

from jaxslam.benchmark.external_program import kill_with_children
from jaxslam.benchmark.process_clock import ProcessClock
from jaxslam.benchmark.process_ending import how_it_ended, last_words
from jaxslam.benchmark.suites.opened_clip import OpenedClip, opened
from jaxslam.benchmark.suites.provenance import sources_sha256, system_sha256
from jaxslam.benchmark.suites.run_names import flattened, run_folder
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.system import System
from jaxslam.config.loading import load_config, to_yaml
from jaxslam.config.schema import Config
from jaxslam.datasets.synthetic import SyntheticConfig
from jaxslam.datasets.synthetic.sensor_noise import SensorConfig
from jaxslam.errors import BenchmarkError, JaxSlamError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.yaml_files import parse_yaml
from jaxslam.runtime.compile_cache import enable_compile_cache
from jaxslam.runtime.machine import machine
from jaxslam.runtime.threads import bound_threads

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
        preset: Preset to track with, or the name of another system.
        variant: Name of further settings; empty for none.
        settings: Settings `key=value`, in the order in which they are applied.
        seed: Seed of every random choice; for another system, the number of the run.
        system: Other system whose trajectory is judged; `None` for a run of jaxslam.
    """

    clip: Clip
    preset: str
    variant: str
    settings: tuple[str, ...]
    seed: int
    system: System | None = None

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
        """Every setting of a run of jaxslam; that of another system has none."""
        return load_config(self.preset, overrides=(*self.settings, f"run.seed={self.seed}"))

    def to_json(self) -> str:
        """Return the job as text, from which `of_json` makes an equal job."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def of_json(cls, text: str) -> "Job":
        """The job of which this is the text."""
        fields = json.loads(text)
        clip, system = fields.pop("clip"), fields.pop("system")
        room = clip.pop("room")
        if room is not None:
            room = SyntheticConfig(**room | {"sensor": SensorConfig(**room["sensor"])})
        other = None if system is None else System(**system)
        return cls(Clip(room=room, **clip), **fields | {"settings": tuple(fields["settings"]), "system": other})


def stored(job: Job, out: Path) -> tuple[dict[str, Any], list[str]] | None:
    """The result of a job that has been run to its end, if there is one.

    Returns:
        Its figures, and what is different about the job now, in words: none if it has the settings and the sequence
        that it was run with, and nobody has changed the file.

    Raises:
        BenchmarkError: If the files of the run cannot be read.
    """
    found = _left_by_a_run(job, out)
    return None if found is None or found[0]["status"] != DONE else found


def _left_by_a_run(job: Job, out: Path) -> tuple[dict[str, Any], list[str]] | None:
    """Return what `stored` does, also for a run that failed."""
    folder = out / job.folder
    try:
        result = json.loads((folder / RESULT).read_text())
        before = json.loads((folder / _JOB).read_text())
        clip = before["clip"]
        config = None if job.system is not None else _read_config((folder / _CONFIG).read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, BenchmarkError) as problem:
        raise BenchmarkError(f"{folder}: expected the results of a run, got something unreadable: {problem}") from None
    now = json.loads(job.to_json())
    different = _differences(clip, now["clip"]) + _differences(before.get("system"), now["system"])
    if config is not None:
        different += _differences(config, _read_config(to_yaml(job.config)))
    if _CHECKSUM not in result:
        different.append(f"{RESULT} is of an older jaxslam, which did not say what it depends on")
    elif result[_CHECKSUM] != _checksum(result):
        different.append(f"{RESULT} is not as the run wrote it")
    return result, different


def _read_config(text: str) -> dict[str, Any]:
    return parse_yaml(text, _CONFIG, BenchmarkError)


def _differences(before: Mapping[str, Any] | None, now: Mapping[str, Any] | None) -> list[str]:
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
    command = [sys.executable, "-m", "jaxslam.benchmark.suites.job", str(folder), f"--began={time.time()}"]
    for name, path in (("--root", root), ("--rooms", rooms)):
        command += [] if path is None else [name, str(path)]
    reading, writing = os.pipe()  # which closes if this process ends, however it does
    try:
        done = subprocess.run(command, stdin=reading, capture_output=True, text=True, errors="replace", check=False)
    finally:
        os.close(reading)
        os.close(writing)
    (folder / "log.txt").write_text(done.stdout + done.stderr)
    left = _left_by_a_run(job, out)
    made = left is not None and not left[1] and done.returncode == 0
    if left is None or not made or left[0]["status"] != DONE:
        (folder / RESULT).unlink(missing_ok=True)
    if left is not None and made:
        return left[0]
    other = "; ".join(left[1]) if left is not None and done.returncode == 0 else ""
    return failed(job, f"it was run otherwise than planned: {other}" if other else _problem(done))


def failed(job: Job, problem: str) -> dict[str, Any]:
    """Make the result of a run that failed."""
    return about(job) | {"status": FAILED, "problem": problem}


def not_run(job: Job) -> dict[str, Any]:
    """Make the result of a planned run that has not been made."""
    return about(job) | {"status": NOT_RUN, "problem": None}


def run_here(folder: Path, root: Path | None, rooms: Path | None, clock: ProcessClock) -> None:
    """Run the job that is written in a folder; its results go there.

    Args:
        folder: Folder of the job.
        root: Folder in which recordings are looked for first.
        rooms: Folder in which rendered frames are kept.
        clock: Clock of this process.

    Raises:
        JaxSlamError: If its recording is not there or not fit to be tracked, or a file cannot be written.
    """
    job, sources = Job.of_json((folder / _JOB).read_text()), sources_sha256()
    if job.system is None:
        bound_threads(job.config.run.threads)
    enable_compile_cache()
    has_frames = job.system is None or bool(job.system.command)  # of a trajectory, frames have been tracked elsewhere
    with clock.stopped():
        given = opened(job.clip, root, rooms if has_frames else None, rendered=has_frames)
    made = _ours(job, given, folder, clock) if job.system is None else _another(job, job.system, given, folder)
    result = about(job) | {"status": DONE, "problem": None} | made | given.figures() | {"sources_sha256": sources}
    result |= {_CHECKSUM: _checksum(result)}
    write_atomically(folder / RESULT, (json.dumps(result, indent=2) + "\n").encode(), BenchmarkError)


def _ours(job: Job, given: OpenedClip, folder: Path, clock: ProcessClock) -> dict[str, Any]:
    from jaxslam.benchmark.suites.tracked_run import track  # noqa: PLC0415 - nothing else needs the tracker

    return track(given, job.preset, job.config, folder, clock)


def _another(job: Job, system: System, given: OpenedClip, folder: Path) -> dict[str, Any]:
    from jaxslam.benchmark.suites.external_run import run_system  # noqa: PLC0415 - nothing else needs to evaluate

    run = run_system(system, job.seed, given, folder)
    known = {"system_sha256": system_sha256(system, job.clip, job.seed), "lacks_network": False, "networks_sha256": {}}
    figures = machine() | known | run.figures
    return figures if run.problem is None else figures | {"status": FAILED, "problem": run.problem}


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
        for child in psutil.Process().children():  # the program of another system
            kill_with_children(child.pid)
        os._exit(1)

    threading.Thread(target=wait, name="jaxslam-parent", daemon=True).start()


def _main(arguments: Sequence[str]) -> None:
    _end_with_parent()
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--rooms", type=Path)
    parser.add_argument("--began", type=float, default=time.time())
    chosen = parser.parse_args(arguments)
    try:
        run_here(chosen.folder, chosen.root, chosen.rooms, ProcessClock(chosen.began))
    except JaxSlamError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    _main(sys.argv[1:])
