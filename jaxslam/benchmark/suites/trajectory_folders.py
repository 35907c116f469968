"""Folders of trajectories that other systems have left, found by the name of the sequence."""

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.errors import BenchmarkError

_ENDINGS = (".txt", ".tum", ".csv", ".kitti")
_KITTI = re.compile(r"kitti_(\d\d)")
_VSLAMLAB = re.compile(r"\d+_KeyFrameTrajectory\.(?:csv|txt)")
_MOST_NAMED = 5


def trajectories_of(folder: Path, clip: Clip) -> list[Path]:
    """The trajectories of a sequence, one a run.

    A sequence has its own name, that of its recording, and `00` if that is `kitti_00`. The first of these that is there
    counts:

    - `NAME.txt`, one run, or `NAME/0.txt`, `NAME/1.txt`, ..., a file a run; `.tum`, `.csv` and `.kitti` do as well
    - `DATASET/NAME/00000_KeyFrameTrajectory.csv`, `DATASET/NAME/00001_KeyFrameTrajectory.csv`, ..., where the folder is
      that of an experiment of VSLAM-LAB. Source: `Experiment.folder` and `evaluate_sequence` (`Evaluate/
      evaluate_functions.py`) of github.com/VSLAM-LAB/VSLAM-LAB; earlier versions wrote `.txt`.

    Args:
        folder: Folder to look in.
        clip: Sequence to look for.

    Returns:
        Files in the order of the runs; none if there is no such file.

    Raises:
        BenchmarkError: If several files could be that of the same run.
    """
    for name in _names(clip):
        for files in (_single(folder, name), _numbered(folder / name), _of_vslamlab(folder, name)):
            if files:
                return _one_a_run(files)
    return []


def lacking_trajectories(system: str, folder: Path, clips: Sequence[Clip]) -> dict[str, str]:
    """Sequences without a trajectory, as rows of tables, and why they are not judged.

    Args:
        system: Name of the system.
        folder: Folder of its trajectories.
        clips: Sequences of the suite.

    Raises:
        BenchmarkError: If none has one, or several files could be that of the same run.
    """
    lacking = [clip for clip in clips if not trajectories_of(folder, clip)]
    if clips and len(lacking) == len(clips):
        raise BenchmarkError(
            f"{system}: expected trajectories such as {clips[0].name}.txt, {clips[0].name}/0.txt or DATASET/"
            f"{clips[0].name}/00000_KeyFrameTrajectory.csv in {folder}, got {_content(folder)}"
        )
    return {f"{clip.name}, {system}": f"no trajectory in {folder}" for clip in lacking}


def is_of_vslamlab(file: Path) -> bool:
    """Tell by its name whether a trajectory is one of VSLAM-LAB, whose poses are those of keyframes."""
    return _VSLAMLAB.fullmatch(file.name) is not None


def _names(clip: Clip) -> list[str]:
    short = _KITTI.fullmatch(clip.recording)
    return list(dict.fromkeys(filter(None, (clip.name, clip.recording, short and short[1]))))


def _single(folder: Path, name: str) -> list[Path]:
    return [file for ending in _ENDINGS if (file := folder / f"{name}{ending}").is_file()]


def _numbered(folder: Path) -> list[Path]:
    return [file for file in _files(folder) if file.suffix in _ENDINGS and file.stem.isdecimal()]


def _of_vslamlab(folder: Path, name: str) -> list[Path]:
    return [file for path in sorted(folder.glob("*/")) for file in _files(path / name) if is_of_vslamlab(file)]


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.glob("*")) if path.is_file())


def _one_a_run(files: Sequence[Path]) -> list[Path]:
    """Sort files by the number of their run; two of the same run are an error."""
    by_run: dict[int, Path] = {}
    for file in files:
        number = int("".join(itertools.takewhile(str.isdecimal, file.stem)) or 0)
        if number in by_run:
            raise BenchmarkError(f"expected one trajectory a run, got {by_run[number]} and {file}")
        by_run[number] = file
    return [by_run[number] for number in sorted(by_run)]


def _content(folder: Path) -> str:
    names = sorted(path.name for path in folder.iterdir())
    shown = ", ".join(names[:_MOST_NAMED])
    return f"{shown}{', ...' if len(names) > _MOST_NAMED else ''}" if names else "an empty folder"
