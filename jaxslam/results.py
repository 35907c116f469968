"""What a run leaves behind: trajectories, a summary, the settings in effect, and a picture."""

import json
import platform
import resource
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.config import to_yaml
from jaxslam.datasets import Dataset
from jaxslam.errors import TrajectoryError
from jaxslam.evaluation import Evaluation, evaluate
from jaxslam.files import write_atomically
from jaxslam.frame import Frame
from jaxslam.map_export import write_keyframe_trajectory
from jaxslam.mask_pictures import write_mask_pictures
from jaxslam.slam import Slam
from jaxslam.state import TrackStatus
from jaxslam.tracked import FrameRecord, Rejected, Tracked
from jaxslam.trajectory import write_tum
from jaxslam.visualize import Snapshot, plot_map, plot_trajectory
from jaxslam.xla import threads, usable_cores

_PACKAGES = ("jaxslam", "jax", "jaxlib", "jaxlie", "equinox", "optimistix", "numpy", "opencv-python-headless")
_ALWAYS = ("trajectory.txt", "trajectory_online.txt", "summary.json", "config.yaml")
_OF_THE_PATH = ("plot.png",)
_OF_THE_MAP = ("trajectory_keyframes.txt", "map.png")
_OF_MASKS = ("masks.png", "masks.gif")
RESULT_FILES = (*_ALWAYS, *_OF_THE_PATH, *_OF_THE_MAP, *_OF_MASKS)
"""All that a run can leave behind: no path, no keyframes, no masks, none of their files."""
_NUM_SNAPSHOTS = 4


class Snapshots:
    """Keeps a few frames of a run, evenly spread, with their points: the `on_frame` of `Slam.run`."""

    def __init__(self, num_frames: int) -> None:
        """Choose which of `num_frames` frames to keep."""
        self._wanted = set(np.linspace(0, num_frames - 1, _NUM_SNAPSHOTS + 1)[1:].round().astype(int).tolist())
        self._seen = 0
        self.kept: list[Snapshot] = []

    def __call__(self, frame: Frame | None, result: Tracked | Rejected) -> None:
        """Look at one frame."""
        if self._seen in self._wanted and frame is not None and isinstance(result, Tracked):
            title = f"frame {self._seen}: {result.status.name}, {result.num_inliers} inliers"
            self.kept.append(Snapshot(title, frame.image, result.uv, result.weights, result.followed))
        self._seen += 1


@dataclass(frozen=True)
class RunInfo:
    """What the results of a run cannot tell by themselves."""

    dataset: Dataset
    preset: str
    wall_s: float


def write_results(
    folder: Path,
    slam: Slam,
    records: Sequence[FrameRecord],
    info: RunInfo,
    snapshots: Sequence[Snapshot] = (),
    masks: Sequence[np.ndarray] = (),
) -> tuple[dict[str, Any], Evaluation | None]:
    """Write those of `RESULT_FILES` there is something for: trajectories, a summary, the settings, pictures.

    Args:
        folder: Where they go; made if it is not there. Files of an earlier run are replaced, each in one piece, or
            removed if this one has none.
        slam: What tracked.
        records: From `Slam.run`.
        info: The recording and how it was run.
        snapshots: Frames to show below the plots.
        masks: `MaskPictures.kept`.

    Returns:
        The summary, and the evaluation if there is ground truth to compare with.
    """
    folder.mkdir(parents=True, exist_ok=True)
    truth = info.dataset.ground_truth
    evaluation, problem = None, None if truth is not None else "no ground truth"
    if truth is not None:
        try:
            evaluation = evaluate(slam.trajectory, truth)
        except TrajectoryError as error:
            problem = str(error)
    summary = _summary(slam, records, info, evaluation) | {"evaluation_problem": problem}
    write_tum(folder / "trajectory.txt", slam.trajectory)
    write_tum(folder / "trajectory_online.txt", slam.online_trajectory)
    write_atomically(folder / "config.yaml", to_yaml(slam.config).encode())
    write_atomically(folder / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    absent: list[str] = []
    if len(slam.trajectory):
        plot_trajectory(slam.trajectory, truth, evaluation, folder / "plot.png", snapshots)
    else:
        absent += _OF_THE_PATH
    if len(slam.map.ids):
        write_keyframe_trajectory(folder / "trajectory_keyframes.txt", slam.map)
        plot_map(slam.map, slam.trajectory, folder / "map.png")
    else:
        absent += _OF_THE_MAP
    if masks:
        write_mask_pictures(folder, masks)
    else:
        absent += _OF_MASKS
    for name in absent:
        (folder / name).unlink(missing_ok=True)
    return summary, evaluation


def _summary(
    slam: Slam, records: Sequence[FrameRecord], info: RunInfo, evaluation: Evaluation | None
) -> dict[str, Any]:
    statuses = Counter(record.status.name for record in records)
    lost = [record for record in records if record.status in (TrackStatus.LOST, TrackStatus.REJECTED)]
    dropped = statuses[TrackStatus.DROPPED.name]
    given = len(records) - dropped
    tracked = given - len(lost)
    figures = evaluation.summary() if evaluation is not None else {}
    wanted = ("ate_rmse_m", "ate_sim3_rmse_m", "sim3_scale", "rpe_trans_m_per_s", "rpe_rot_deg_per_s")
    return {
        "dataset": info.dataset.name,
        "camera": info.dataset.camera.name,
        "preset": info.preset,
        "deterministic": slam.config.run.in_turn,
        "realtime": slam.config.run.realtime,
        "seed": slam.config.run.seed,
        "frames": len(records),
        "tracked": tracked,
        "tracked_percent": round(100 * tracked / max(given, 1), 3),  # of the frames that were not dropped
        "dropped": dropped,
        "dropped_percent": round(100 * dropped / max(len(records), 1), 3),
        "status_counts": dict(sorted(statuses.items())),
        "first_loss_s": (lost[0].timestamp_ns - records[0].timestamp_ns) * 1e-9 if lost else None,
        "relocalised": statuses[TrackStatus.RELOCALISED.name],
        "keyframes": len(slam.map.ids),
        "keyframes_made": sum(record.is_keyframe for record in records),
        "map_points": len(slam.map.points.ids),
        "loops_closed": slam.loops_closed,
        "submaps": len(set(slam.map.submap.tolist())),
        **{name: figures.get(name) for name in wanted},
        "evaluation": figures or None,
        "mask_sources": dict(sorted(Counter(record.mask_source.name for record in records).items())),
        "mask_age_frames": _distribution([record.mask_age for record in records if record.mask_age >= 0]),
        "detector_errors": sum(bool(record.detector_error) for record in records),
        "track_ms": _distribution([record.track_ms for record in records if record.track_ms is not None]),
        "compile_s": round(slam.compile_s, 3),
        "wall_s": round(info.wall_s, 3),
        "peak_rss_mb": round(_peak_rss_mb(), 1),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}},
        "cpu": _cpu_model(),
        "cores": usable_cores(),
        "threads": threads(),
        "commit": _commit(),
    }


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


def _peak_rss_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)  # bytes there, kilobytes elsewhere


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit of the checkout jaxslam runs from, `+` behind it if the checkout has changes; `None` if installed."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(root), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
