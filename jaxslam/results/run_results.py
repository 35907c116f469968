"""Write the results of a run: trajectories, a log of its frames, a summary, the settings in effect, and pictures."""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.config.loading import to_yaml
from jaxslam.datasets import Dataset
from jaxslam.errors import TrajectoryError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.download import sha256_of
from jaxslam.map.export import write_keyframe_trajectory
from jaxslam.mapping.occlusion_states import occluded_shares
from jaxslam.results.dense_results import DENSE_FILES, write_dense
from jaxslam.results.evaluated_run import EvaluatedRun, evaluate_run
from jaxslam.results.frame_table import write_errors, write_frames
from jaxslam.runtime.machine import machine, peak_rss_mb
from jaxslam.slam.frame_result import FrameRecord
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.consistency import RelativePoses, evaluate_consistency
from jaxslam.trajectory.evaluation import Evaluation
from jaxslam.trajectory.trajectory import Trajectory, write_kitti_frames, write_tum
from jaxslam.visualization.consistency_plot import plot_consistency
from jaxslam.visualization.mask_gallery import write_mask_pictures
from jaxslam.visualization.plots import Snapshot, plot_map, plot_snapshots, plot_trajectory
from jaxslam.visualization.snapshots import RunPictures

_ALWAYS = ("trajectory.txt", "trajectory_online.txt", "frames.csv", "summary.json", "config.yaml")
_OF_THE_PATH = ("plot.png", "trajectory_kitti.txt")
_OF_THE_MAP = ("trajectory_keyframes.txt", "map.png")
_ERRORS, _CONSISTENCY, _FAILURES = "errors.csv", "consistency.png", "failures.png"
_OTHER_SUBMAP = "trajectory_submap_{}.txt"
_OF_MASKS = ("masks.png", "masks.gif")
RESULT_FILES = (
    *(*_ALWAYS, *_OF_THE_PATH, *_OF_THE_MAP),
    *(_ERRORS, _CONSISTENCY, _FAILURES, *_OF_MASKS, *DENSE_FILES),
)
"""All files that a run can write. A run without a path, keyframes, ground truth, masks or a dense map writes none of
the files about them."""


@dataclass(frozen=True)
class RunInfo:
    """Facts about a run that its results do not hold.

    Attributes:
        dataset: Recording that was tracked.
        preset: Name of the preset.
        wall_s: Duration of the run in seconds.
        cut_short: Reason why the run ended before the recording did: "interrupted", "terminated", or an error; `None`
            if the run was complete.
    """

    dataset: Dataset
    preset: str
    wall_s: float
    cut_short: str | None = None


def write_results(
    folder: Path,
    slam: Slam,
    records: Sequence[FrameRecord],
    info: RunInfo,
    pictures: RunPictures | None = None,
    poses: RelativePoses | None = None,
) -> tuple[dict[str, Any], Evaluation | None]:
    """Write the files of `RESULT_FILES` that the run has content for: trajectories, a summary, settings and pictures.

    Args:
        folder: Folder of the files, which is created if missing. Files of an earlier run are replaced atomically, or
            removed if this run does not write them.
        slam: System that tracked the recording.
        records: One record per frame, from `Slam.run`.
        info: Recording, preset and duration of the run.
        pictures: Frames that were kept to be shown.
        poses: Poses with their covariances, from `RelativePoseLog`, which are compared with the ground truth; `None`
            to leave that out.

    Returns:
        summary: Content of `summary.json`.
        evaluation: Errors of the trajectory; `None` without ground truth.
    """
    folder.mkdir(parents=True, exist_ok=True)
    truth, trajectory = info.dataset.ground_truth, slam.trajectory  # made anew at each call
    evaluated = evaluate_run(trajectory, info.dataset)
    evaluation = evaluated.evaluation
    dense, dense_files = write_dense(folder, slam.dense_mapping, trajectory, slam.times.ms)
    summary = _summary(slam, records, info, evaluated) | {
        **_write_consistency(folder / _CONSISTENCY, truth, poses, _title(slam, info)),
        "dense": dense,
        "poses_in_other_submaps": _write_other_submaps(folder, slam),
    }
    write_tum(folder / "trajectory.txt", trajectory)
    write_tum(folder / "trajectory_online.txt", slam.online_trajectory)
    write_frames(folder / "frames.csv", records)
    write_atomically(folder / "config.yaml", to_yaml(slam.config).encode())
    write_atomically(folder / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    there = {
        *_ALWAYS,
        *dense_files,
        *_write_pictures(folder, slam, trajectory, info, evaluation, pictures or RunPictures(0)),
    }
    if evaluation is not None:
        write_errors(folder / _ERRORS, evaluation)
        there.add(_ERRORS)
    if summary["consistency"] is not None:
        there.add(_CONSISTENCY)
    for name in there.symmetric_difference(RESULT_FILES):
        (folder / name).unlink(missing_ok=True)
    return summary, evaluation


def _write_other_submaps(folder: Path, slam: Slam) -> dict[str, int]:
    """Write the trajectory of every submap that is not linked to the world frame; return the poses in each file."""
    for file in folder.glob(_OTHER_SUBMAP.format("*")):
        file.unlink()
    others = {n: path for n, path in slam.trajectories.items() if n != slam.map.world_submap}
    for number, path in others.items():
        write_tum(folder / _OTHER_SUBMAP.format(number), path)
    return {_OTHER_SUBMAP.format(number): len(path) for number, path in others.items()}


def _write_consistency(path: Path, truth: Trajectory | None, poses: RelativePoses | None, title: str) -> dict[str, Any]:
    """Compare poses with their covariances, draw that, and return its part of the summary.

    A covariance that cannot be compared is named there: it costs the run no other file.
    """
    consistency, problem = None, None
    if truth is not None and poses is not None:
        try:
            consistency = evaluate_consistency(poses, truth)
        except TrajectoryError as error:
            problem = str(error)
    if consistency is not None:
        plot_consistency(consistency, path, title=title)
    figures = None if consistency is None else consistency.summary()
    return {"consistency": figures, "consistency_problem": problem}


def _write_pictures(
    folder: Path,
    slam: Slam,
    trajectory: Trajectory,
    info: RunInfo,
    evaluation: Evaluation | None,
    pictures: RunPictures,
) -> list[str]:
    """Write the pictures that the run has content for, and return the names of the files."""
    written: list[str] = []
    if len(trajectory):
        plot_trajectory(
            trajectory,
            info.dataset.ground_truth,
            evaluation,
            folder / _OF_THE_PATH[0],
            pictures.snapshots,
            title=_title(slam, info),
        )
        write_kitti_frames(folder / _OF_THE_PATH[1], trajectory, info.dataset.timestamps_ns)
        written += _OF_THE_PATH
    if len(slam.map.ids):
        write_keyframe_trajectory(folder / _OF_THE_MAP[0], slam.map, slam.map.world_submap)
        plot_map(slam.map, trajectory, folder / _OF_THE_MAP[1])
        written += _OF_THE_MAP
    failures = [*pictures.losses, *_worst(info.dataset, evaluation)]
    if failures:
        plot_snapshots(failures, folder / _FAILURES)
        written.append(_FAILURES)
    if pictures.masks:
        write_mask_pictures(folder, pictures.masks)
        written += _OF_MASKS
    return written


def _title(slam: Slam, info: RunInfo) -> str:
    """Return the title of the pictures: recording, preset, and why no network was used."""
    why = slam.without_network
    return f"{info.dataset.name}, {info.preset}" + ("" if why is None else f", without a network ({why})")


def _worst(dataset: Dataset, evaluation: Evaluation | None) -> list[Snapshot]:
    """Return the frame with the largest error, without points; an empty list without an evaluation."""
    if evaluation is None:
        return []
    index = int(np.argmax(evaluation.errors_m))
    frame = int(np.searchsorted(dataset.timestamps_ns, evaluation.timestamps_ns[index]))
    title = f"frame {frame}: the largest error, {evaluation.errors_m[index]:.4f} m"
    nothing = np.zeros((2, 0)), np.zeros(0), np.zeros(0, bool)
    return [Snapshot(title, dataset[frame].image, *nothing)]


def _summary(slam: Slam, records: Sequence[FrameRecord], info: RunInfo, evaluated: EvaluatedRun) -> dict[str, Any]:
    keyframe_reasons = Counter(record.keyframe.name for record in records if record.is_keyframe)
    return {
        "dataset": info.dataset.name,
        "camera": info.dataset.camera.name,
        "preset": info.preset,
        "cut_short": info.cut_short,
        "model": slam.config.semantics.model,
        "networks": {setting: path and _hashed(path) for setting, path in slam.networks.items()},
        "without_network": slam.without_network,
        "deterministic": slam.config.run.in_turn,
        "realtime": slam.config.run.realtime,
        "seed": slam.config.run.seed,
        **_frame_counts(records),
        "keyframes": len(slam.map.ids),
        "keyframes_made": keyframe_reasons.total(),
        "keyframe_reasons": dict(sorted(keyframe_reasons.items())),
        "map_points": len(slam.map.points.ids),
        "loops_closed": slam.loops_closed,
        "submaps": len(set(slam.map.submap.tolist())),
        **evaluated.figures,
        "occluded_share": _distribution(_occluded_shares(slam)),
        "mask_sources": dict(sorted(Counter(record.mask_source.name for record in records).items())),
        "mask_age_frames": _distribution([record.mask_age for record in records if record.mask_age >= 0]),
        "removed_by_semantics": slam.removed_by_semantics,
        "keyframes_passed_over": slam.keyframes_passed_over,
        "detector_errors": sum(bool(record.detector_error) for record in records),
        "stage_ms": {stage: _distribution(times.tolist()) for stage, times in slam.times.ms.items()},
        "keyframe_stage_ms": {stage: _distribution(ms.tolist()) for stage, ms in slam.times.keyframe_ms.items()},
        "track_ms": _track_ms(records),
        "keyframe_ms": _track_ms([record for record in records if record.is_keyframe]),
        "between_keyframes_ms": _track_ms([record for record in records if not record.is_keyframe]),
        "compile_s": round(slam.compile_s, 3),
        "wall_s": round(info.wall_s, 3),
        "peak_rss_mb": round(peak_rss_mb(), 1),
        **machine(),
    }


def _hashed(path: Path) -> dict[str, str]:
    return {"file": path.name, "sha256": sha256_of(path)}


def _frame_counts(records: Sequence[FrameRecord]) -> dict[str, Any]:
    """Count the frames that were tracked, dropped or relocalized."""
    statuses = Counter(record.status.name for record in records)
    lost = [record for record in records if record.status in (TrackStatus.LOST, TrackStatus.REJECTED)]
    dropped = statuses[TrackStatus.DROPPED.name]
    given = len(records) - dropped
    tracked = given - len(lost)
    return {
        "frames": len(records),
        "tracked": tracked,
        "tracked_percent": round(100 * tracked / max(given, 1), 3),  # of the frames that were not dropped
        "dropped": dropped,
        "dropped_percent": round(100 * dropped / max(len(records), 1), 3),
        "status_counts": dict(sorted(statuses.items())),
        "first_loss_s": (lost[0].timestamp_ns - records[0].timestamp_ns) * 1e-9 if lost else None,
        "relocalized": statuses[TrackStatus.RELOCALIZED.name],
    }


def _occluded_shares(slam: Slam) -> list[float]:
    """Return the share of the points of each keyframe that are OCCLUDED; empty if occlusion states are disabled."""
    return occluded_shares(slam.map).tolist() if slam.config.dynamics.occlusion.enabled else []


def _track_ms(records: Iterable[FrameRecord]) -> dict[str, float] | None:
    """Summarize the tracking times of frames, milliseconds."""
    return _distribution([record.track_ms for record in records if record.track_ms is not None])


def _distribution(figures: Sequence[float]) -> dict[str, float] | None:
    if not figures:
        return None
    values = np.asarray(figures)
    measures = {
        "mean": values.mean(),
        "median": np.median(values),
        "p95": np.percentile(values, 95),
        "max": values.max(),
    }
    return {name: round(float(value), 3) for name, value in measures.items()}
