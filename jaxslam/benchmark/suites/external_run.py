"""One run of another system: its program is run or its trajectory read, and judged as a run of a preset is."""

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxslam.benchmark.external_program import Ended, run_to_its_end
from jaxslam.benchmark.live.figures import parse_figures
from jaxslam.benchmark.process_ending import how_it_ended, last_words
from jaxslam.benchmark.suites.opened_clip import OpenedClip
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.system import System
from jaxslam.benchmark.suites.trajectory_folders import is_of_vslamlab, trajectories_of
from jaxslam.datasets import Dataset
from jaxslam.datasets.evaluation_files import in_order
from jaxslam.datasets.synthetic import SyntheticDataset, write_tum
from jaxslam.errors import BenchmarkError, JaxSlamError, TrajectoryError
from jaxslam.results.evaluated_run import EvaluatedRun, evaluate_run
from jaxslam.results.frame_table import write_errors
from jaxslam.trajectory.formats import PoseRows, read_rows, read_vslamlab_rows
from jaxslam.trajectory.trajectory import Trajectory, associate, of_rows
from jaxslam.trajectory.trajectory import write_tum as write_trajectory
from jaxslam.visualization.plots import plot_trajectory

PRINTED, ERRORS = "program_output.txt", "program_errors.txt"
"""Files of the standard output and the standard error of a program."""
_ESTIMATE, _CALIBRATION, _RECORDING = "program_trajectory.txt", "calibration.yaml", "recording"
_OF_AN_EARLIER_RUN = (PRINTED, ERRORS, _ESTIMATE, "trajectory.txt", "errors.csv", "plot.png")
_MAX_GAP_S = 0.02
"""Largest difference of timestamps at which a pose is that of a frame, as in `evaluate`."""
_LAST_WORDS = 400
_UNKNOWN = (
    *("model", "without_network", "deterministic", "realtime", "dropped", "dropped_percent", "relocalized", "wall_s"),
    *("first_loss_s", "ate_rmse_m", "evaluation", "track_ms", "stage_ms", "mask_age_frames", "peak_rss_mb"),
)
"""Figures of runs of presets that a run of another system may lack."""


@dataclass
class ExternalRun:
    """Outcome of a run of another system.

    Attributes:
        problem: Why there is no trajectory that can be judged; `None` if there is one.
        figures: Figures of the run by the names of those of presets, as far as they are known.
    """

    problem: str | None = None
    figures: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(_UNKNOWN))


def run_system(system: System, seed: int, given: OpenedClip, folder: Path) -> ExternalRun:
    """Run a system or take its trajectory, and judge that.

    Args:
        system: System to judge.
        seed: Number of the run.
        given: Sequence.
        folder: Folder for the files of the run; those of an earlier one are removed.
    """
    for name in _OF_AN_EARLIER_RUN:
        (folder / name).unlink(missing_ok=True)
    run = ExternalRun()
    try:
        path = _made(system, seed, given, folder, run) if system.command else _found(system, seed, given.clip)
        _judge(system, path, given, folder, run)
    except JaxSlamError as problem:
        run.problem = str(problem)
    return run


def _found(system: System, seed: int, clip: Clip) -> Path:
    files = trajectories_of(Path(system.trajectories), clip)
    if seed >= len(files):
        raise BenchmarkError(f"{system.name}: expected {seed + 1} trajectories of {clip.name}, got {len(files)}")
    return files[seed]


def _made(system: System, seed: int, given: OpenedClip, folder: Path, run: ExternalRun) -> Path:
    """Run the program of a system, and return the file of its trajectory."""
    estimate = (folder / _ESTIMATE).absolute()
    program = system.program(_values(seed, given, folder.absolute(), estimate))
    run.figures["command"] = list(program.command)
    place = Path(system.folder) if system.folder else None
    try:
        with (folder / PRINTED).open("wb") as printed, (folder / ERRORS).open("wb") as errors:
            ended = run_to_its_end(program, printed, errors, limit_s=system.limit_s, folder=place)
    finally:
        shutil.rmtree(folder / _RECORDING, ignore_errors=True)  # 0.1 GB for two seconds of a room
    run.figures |= _took(ended)
    if problem := _how_it_failed(system, ended, folder / ERRORS):
        raise BenchmarkError(problem)
    if system.prints_figures:
        run.figures["track_ms"] = _printed_ms(system, folder / PRINTED)
    if not estimate.is_file():
        raise BenchmarkError(f"{system.name}: expected a trajectory in {{out}}, {estimate}; it wrote none")
    return estimate


def _values(seed: int, given: OpenedClip, folder: Path, estimate: Path) -> dict[str, str]:
    """Return the values of the placeholders of a command."""
    calibration = folder / _CALIBRATION
    given.dataset.camera.save(calibration)
    stop = len(given.whole) if given.clip.stop is None else min(given.clip.stop, len(given.whole))
    return {
        "recording": str(_recording(given, folder)),
        "calibration": str(calibration),
        "out": str(estimate),
        "start": str(given.clip.start),
        "stop": str(stop),
        "every": str(given.clip.every),
        "rate": f"{given.rate_hz:g}",
        "seed": str(seed),
    }


def _recording(given: OpenedClip, folder: Path) -> Path:
    """Return the folder of the recording; a rendered room is written to one in the layout of TUM RGB-D."""
    if given.folder is not None:
        return given.folder.absolute()
    if not isinstance(given.whole, SyntheticDataset):
        raise BenchmarkError(
            f"{given.clip.name}: expected a recording or a room for another program, got the world {given.clip.world};"
            " `jaxslam world render` makes a recording of it"
        )
    path = folder / _RECORDING
    shutil.rmtree(path, ignore_errors=True)  # of a run that was killed
    write_tum(given.whole, path)
    return path


def _took(ended: Ended) -> dict[str, Any]:
    return {
        "exit_code": ended.exit_code,
        "timed_out": ended.exit_code is None,
        "process_wall_s": round(ended.wall_s, 3),
        "process_cpu_s": None if ended.cpu_s is None else round(ended.cpu_s, 3),
        "peak_rss_mb": round(ended.peak_mb, 1),
    }


def _printed_ms(system: System, printed: Path) -> dict[str, float | None]:
    """Read the times of frames that a program has printed, milliseconds.

    Raises:
        BenchmarkError: If it has printed none.
    """
    found = parse_figures(system.name, printed.read_text(errors="replace"))
    return {"median": found.median_ms, "p95": found.p95_ms, "max": found.max_ms}


def _how_it_failed(system: System, ended: Ended, errors: Path) -> str | None:
    if ended.exit_code == 0:
        return None
    if ended.exit_code is None:
        return f"{system.name}: timed out after {system.limit_s:g} s and was killed"
    said = last_words(errors.read_text(errors="replace"))[-_LAST_WORDS:]
    return f"{system.name}: {how_it_ended(ended.exit_code)}: {said}"


def _judge(system: System, path: Path, given: OpenedClip, folder: Path, run: ExternalRun) -> None:
    """Evaluate a trajectory, add its figures to those of a run, and write its files."""
    frames_ns = given.dataset.timestamps_ns
    trajectory, notes = _read(path, given)
    at_frame, of_frame = associate(trajectory.timestamps_ns, frames_ns, _MAX_GAP_S)
    if not len(at_frame):
        raise TrajectoryError(f"{path}: {_no_frame(trajectory, frames_ns)}")
    if (others := len(trajectory) - len(at_frame)) and given.clip.whole:
        notes += (f"{others} of {len(trajectory)} poses are at the time of no frame, and are left out",)
    if system.command and not given.clip.whole and not system.chooses_part:
        notes += ("the program was given the whole recording: its times and its memory are of all of it",)
    trajectory = trajectory.select(at_frame)
    evaluated = evaluate_run(trajectory, given.dataset, notes)
    run.figures |= {
        "frames": len(frames_ns),
        "tracked": len(of_frame),
        "tracked_percent": round(100 * len(of_frame) / len(frames_ns), 3),
        **evaluated.figures,
    }
    _write(folder, trajectory, given.dataset, evaluated, title=f"{given.dataset.name}, {system.name}")


def _read(path: Path, given: OpenedClip) -> tuple[Trajectory, tuple[str, ...]]:
    """Read a trajectory, with notes on what was done to it."""
    if not is_of_vslamlab(path):
        rows = read_rows(path)
        return (of_rows(rows, _stamps(rows, given)), ()) if rows.timestamps_ns is None else in_order("trajectory", rows)
    rows = read_vslamlab_rows(path) if path.suffix == ".csv" else read_rows(path)
    trajectory, notes = in_order("trajectory", rows)
    return trajectory, (*notes, "poses of keyframes alone, as VSLAM-LAB keeps them: of other frames nothing is known")


def _stamps(rows: PoseRows, given: OpenedClip) -> Int[np.ndarray, " n"]:
    """Return the timestamps of the rows of KITTI, which are those of all frames."""
    for dataset in (given.dataset, given.whole):
        if len(dataset) == len(rows):
            return dataset.timestamps_ns
    part = "" if given.clip.whole else f", or {len(given.whole)} of the whole recording"
    raise TrajectoryError(
        f"{rows.path}: rows of KITTI have no timestamps: expected a row a frame, {len(given.dataset)}{part}, got"
        f" {len(rows)}"
    )


def _no_frame(trajectory: Trajectory, frames_ns: Int[np.ndarray, " f"]) -> str:
    spans = (f"{stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s" for stamps in (trajectory.timestamps_ns, frames_ns))
    poses, frames = spans
    return (
        f"no pose within {1e3 * _MAX_GAP_S:g} ms of a frame: {len(trajectory)} poses from {poses}, {len(frames_ns)}"
        f" frames from {frames}; are the timestamps those of the recording, in seconds?"
    )


def _write(folder: Path, trajectory: Trajectory, dataset: Dataset, evaluated: EvaluatedRun, *, title: str) -> None:
    write_trajectory(folder / "trajectory.txt", trajectory)
    plot_trajectory(trajectory, dataset.ground_truth, evaluated.evaluation, folder / "plot.png", title=title)
    if evaluated.evaluation is not None:
        write_errors(folder / "errors.csv", evaluated.evaluation)
