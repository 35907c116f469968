"""Run a tracker for `demo`, `run` and `compare`: a progress bar, the results, and a summary of them."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from jaxslam.cli.console import console, make_table, text_column
from jaxslam.cli.interruption import Interruption
from jaxslam.datasets import Dataset
from jaxslam.errors import ConfigError, one_line
from jaxslam.io.atomic_files import check_writable, make_folder
from jaxslam.results.partial_results import PartialResults
from jaxslam.results.run_results import RESULT_FILES, RunInfo, write_results
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_records import FrameRecords
from jaxslam.slam.frame_result import FrameRecord, FrameResult, Rejected
from jaxslam.slam.relative_pose_log import RelativePoseLog
from jaxslam.slam.slam import Slam
from jaxslam.trajectory.evaluation import Evaluation
from jaxslam.visualization.snapshots import RunPictures

if TYPE_CHECKING:
    from jaxslam.visualization.rerun_viewer import Viewer

_log = logging.getLogger(__name__)

_OnFrame: TypeAlias = Callable[[Frame | None, FrameResult | Rejected], None]


@dataclass
class _Meter:
    """A progress bar that also says how tracking goes, keeps the records of frames, and stops on Ctrl-C."""

    progress: Progress
    task: Any
    watchers: Sequence[_OnFrame]
    interruption: Interruption
    records: FrameRecords = field(default_factory=FrameRecords)
    statuses: dict[str, int] = field(default_factory=dict)

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        self.records.append(FrameRecord.of(result))
        for watcher in self.watchers:
            watcher(frame, result)
        self.statuses[result.status.name] = self.statuses.get(result.status.name, 0) + 1
        text = "  ".join(f"{name.lower()} {count}" for name, count in self.statuses.items())
        self.progress.update(self.task, advance=1, status=text)
        self.interruption.check()


def make_viewer(slam: Slam, dataset: Dataset, *, live: bool, path: Path | None) -> "Viewer | None":
    """Make the viewer if one is wanted; rerun is a large package that many will not have."""
    if not live and path is None:
        return None
    from jaxslam.visualization.rerun_viewer import Viewer  # noqa: PLC0415

    return Viewer(slam, dataset.ground_truth, path=path, live=live)


def track(
    dataset: Dataset,
    slam: Slam,
    preset: str,
    out: Path,
    viewer: "Viewer | None" = None,
    *,
    save_map: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Track with a progress bar, write the results, and print them unless `quiet`.

    Ctrl-C, SIGTERM or an error ends tracking early. The results so far are written then as well, marked as cut short,
    before it is raised again; another Ctrl-C while they are written ends that at once.

    Args:
        dataset: The recording.
        slam: Tracks it.
        preset: Name of the preset, for the summary.
        out: Folder for the results.
        viewer: Shows the run.
        save_map: File to write the map to.
        quiet: Print nothing but the progress bar.

    Returns:
        The summary.

    Raises:
        ConfigError: Before anything is done, if results cannot be written to `out` or `save_map`.
        KeyboardInterrupt: After Ctrl-C or SIGTERM.
    """
    began = time.perf_counter()
    pictures, poses = RunPictures(len(dataset)), RelativePoseLog()
    with Interruption() as interruption, slam, viewer or nullcontext():
        make_folder(out, ConfigError)
        if save_map is not None:
            check_writable(save_map, "--save-map", ConfigError)
        with PartialResults(out) as partial:
            watchers = [pictures, poses, partial, *([] if viewer is None else [viewer])]
            records, failure = _tracked(dataset, slam, watchers, interruption, quiet=quiet)
            cut_short = None if failure is None else _why_cut_short(failure, interruption)
            if cut_short is not None:
                console.print(f"Cut short ({cut_short}): writing what was computed. Ctrl-C ends at once.", markup=False)
            info = RunInfo(dataset, preset, time.perf_counter() - began, cut_short)
            try:
                summary, evaluation = write_results(out, slam, records, info, pictures, poses.poses())
            except Exception:  # a second Ctrl-C ends at once, but a picture that fails costs no map
                _save_map(slam, save_map)
                raise
        if not quiet:
            _print_summary(summary, evaluation, out)
        _save_map(slam, save_map)
        if failure is not None:
            raise failure
        interruption.check()
    return summary


def _tracked(
    dataset: Dataset, slam: Slam, watchers: Sequence[_OnFrame], interruption: Interruption, *, quiet: bool
) -> tuple[FrameRecords, BaseException | None]:
    """The records of all frames, or of those until something ended the run, and what that was."""
    columns = (
        text_column("Tracking"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        text_column("{task.fields[status]}"),
    )
    records = FrameRecords()
    try:
        with console.status("Compiling the tracker (some 20 s at the first start on a machine, then 1) ..."):
            slam.warm_up()
        if not quiet:
            console.print(f"Tracker ready after {slam.compile_s:.1f} s.")
        interruption.check()
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("track", total=len(dataset), status="")
            slam.run(dataset, _Meter(progress, task, watchers, interruption, records))
    except (Exception, KeyboardInterrupt) as failure:  # raised again when the results are written
        _catch_up(slam)
        return records, failure
    return records, None


def _save_map(slam: Slam, path: Path | None) -> None:
    """Write the map to a file, if there is to be one, and say so."""
    if path is not None:
        slam.save(path)
        console.print(f"Map in {path}: {len(slam.map.ids)} keyframes, {len(slam.map.points.ids)} points")


def _catch_up(slam: Slam) -> None:
    """Have mapping do what was handed over to it before a run was cut short."""
    try:
        slam.finish()
    except Exception as problem:
        _log.warning("the map lacks what was mapped last: %s: %s", type(problem).__name__, problem)


def _why_cut_short(failure: BaseException, interruption: Interruption) -> str:
    """One short line."""
    if isinstance(failure, KeyboardInterrupt):
        return interruption.reason or "interrupted"
    return f"{type(failure).__name__}: {one_line(failure)}"


def _print_summary(summary: dict[str, Any], evaluation: Evaluation | None, out: Path) -> None:
    table = make_table(summary["dataset"], "figure", "value", "unit", left=3)
    statuses = ", ".join(f"{name} {count}" for name, count in summary["status_counts"].items())
    if summary["cut_short"] is not None:
        table.add_row("cut short", f"after {summary['frames']} frames", summary["cut_short"])
    table.add_row("tracked", f"{summary['tracked']} of {summary['frames']}", f"frames ({statuses})")
    table.add_row("network", *_network(summary))
    if summary["realtime"]:
        table.add_row("dropped", f"{summary['dropped']} of {summary['frames']}", "frames, which came late")
    if (age := summary["mask_age_frames"]) is not None:
        table.add_row("age of masks, median", f"{age['median']:.0f}", f"frames ({age['p95']:.0f} at p95)")
    table.add_row("map", str(summary["keyframes"]), f"keyframes, {summary['map_points']} points")
    if (dense := summary["dense"]) is not None:
        made = f"points, {dense['megabytes']:.1f} MB, {100 * dense['share_of_measured']:.1f} % of those measured"
        table.add_row("dense map", str(dense["points"]), made)
        if dense["ms_per_keyframe"] is not None:
            table.add_row("dense map, median", number(dense["ms_per_keyframe"]["median"], 1), "ms a keyframe")
    table.add_row("loops closed", str(summary["loops_closed"]), f"{summary['submaps']} submaps")
    table.add_row("ATE (SE(3) aligned)", number(summary["ate_rmse_m"], 4), "m RMSE")
    table.add_row("ATE (Sim(3) aligned)", number(summary["ate_sim3_rmse_m"], 4), "m RMSE")
    pairs = "" if evaluation is None else f" ({evaluation.rpe_spacing})"
    table.add_row("RPE over 1 s", number(summary["rpe_trans_m_per_s"], 4), f"m/s RMSE{pairs}")
    table.add_row("RPE over 1 s, rotation", number(summary["rpe_rot_deg_per_s"], 3), "deg/s RMSE")
    if (consistency := summary["consistency"]) is not None:
        far = f"{consistency['beyond_5_sigma_percent']:.1f} % of poses beyond 5 sigma"
        table.add_row("NEES", number(consistency["nees"], 2), f"1 if covariances are right and the truth exact; {far}")
    if summary["track_ms"] is not None:
        for name in ("median", "p95", "max"):
            table.add_row(f"tracking time, {name}", number(summary["track_ms"][name], 1), "ms a frame")
    console.print(table)
    if evaluation is None:
        console.print(f"Not evaluated: {summary['evaluation_problem']}.")
    for file, poses in summary["poses_in_other_submaps"].items():
        console.print(f"Note: {poses} poses are in a submap that nothing links to the map's frame; they are in {file}.")
    for note in evaluation.notes if evaluation is not None else ():
        console.print(f"Note: {note}.")
    console.print(f"Results in {out}: {', '.join(name for name in RESULT_FILES if (out / name).exists())}")


def _network(summary: dict[str, Any]) -> tuple[str, str]:
    """The network that looked at frames and what made masks of its boxes, or that none did and why."""
    why, networks = summary["without_network"], summary["networks"]
    if why is not None:
        return "none", why
    if "prompt_encoder" not in networks:
        return summary["model"] or "given", ""
    encoder, decoder = networks["prompt_encoder"], networks["prompt_decoder"]
    masks = "depth: no segmenter here" if None in (encoder, decoder) else encoder["file"]
    return summary["model"] or "given", f"masks from {masks}"


def number(value: float | None, digits: int) -> str:
    """A figure for a table, `-` if there is none."""
    return "-" if value is None else f"{value:.{digits}f}"
