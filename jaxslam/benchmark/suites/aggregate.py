"""Summarize the runs of a sequence in a row of a table."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from jaxslam.benchmark.suites.run_names import run_folder
from jaxslam.errors import BenchmarkError, nearest

Statistic: TypeAlias = Literal["median", "least", "most", "mean", "trimmed_mean"]
"""Statistic of the runs of a sequence; the last is the mean without the smallest and the largest, of three or more."""
FEWEST_TO_TRIM = 3
"""Least number of runs of which a `trimmed_mean` is taken."""


class Column(NamedTuple):
    """A column of figures.

    Attributes:
        heading: Heading of the column.
        figure: Name of the figure in `figures_of`.
        digits: Number of decimals.
        which: Statistic of the runs, or `range` for the least and the most.
    """

    heading: str
    figure: str
    digits: int
    which: Statistic | Literal["range"] = "median"


ACCURACY = (
    Column("frames", "frames", 0, "least"),
    Column("tracked, %", "tracked_percent", 1, "least"),
    Column("matched poses", "num_matched", 0, "least"),
    Column("ATE, m", "ate_rmse_m", 4),
    Column("from - to", "ate_rmse_m", 4, "range"),
    Column("ATE Sim(3), m", "ate_sim3_rmse_m", 4),
    Column("RPE, m/s", "rpe_trans_m_per_s", 4),
    Column("RPE, deg/s", "rpe_rot_deg_per_s", 3),
    Column("RPE, m/frame", "rpe_trans_m_per_frame", 5),
    Column("RPE, deg/frame", "rpe_rot_deg_per_frame", 4),
    Column("t_rel, %", "kitti_trans_percent", 3),
    Column("r_rel, deg/100 m", "kitti_rot_deg_per_100m", 3),
    Column("NEES", "nees", 2),
    Column("> 5 sigma, %", "beyond_5_sigma_percent", 1, "most"),
)
"""How good trajectories are; those of KITTI only where a path is long enough."""
RUNNING = (
    Column("dropped, %", "dropped_percent", 1),
    Column("first loss, s", "first_loss_s", 2, "least"),
    Column("found again", "relocalized", 0),
    Column("mask age, frames", "mask_age_median", 0),
    Column("ms", "track_ms_median", 1),
    Column("p95, ms", "track_ms_p95", 1),
    Column("max, ms", "track_ms_max", 1),
    Column("time / LK", "flow_ratio_median", 2),
    Column("p95 / LK", "flow_ratio_p95", 2),
    Column("max / LK", "flow_ratio_max", 2),
    Column("wall, s", "process_wall_s", 1),
    Column("processor, s", "process_cpu_s", 1),
    Column("memory, MB", "peak_rss_mb", 0, "most"),
)
"""How they came about."""
_OF_PROTOCOLS = (
    Column("ATE mean, m", "ate_mean_m", 4),
    Column("ATE median, m", "ate_median_m", 4),
    Column("ATE S.D., m", "ate_std_m", 4),
    Column("RPE mean, m/s", "rpe_trans_mean_m_per_s", 4),
    Column("RPE median, m/s", "rpe_trans_median_m_per_s", 4),
    Column("RPE S.D., m/s", "rpe_trans_std_m_per_s", 4),
    Column("RPE mean, deg/s", "rpe_rot_mean_deg_per_s", 3),
    Column("RPE median, deg/s", "rpe_rot_median_deg_per_s", 3),
    Column("RPE S.D., deg/s", "rpe_rot_std_deg_per_s", 3),
    Column("mean, ms", "track_ms_mean", 1),
)
"""More figures of tables of papers."""
_STAGES = (
    *("take over", "flow", "wait for mask", "pose", "match with map", "hand over"),
    *("match pair", "masks", "detector", "mapping", "places"),
)
"""Stages and jobs of a frame, as `Slam.times` names them."""


def _stage_figure(kind: str, stage: str) -> str:
    """Name the mean time of a stage: `stage_flow_ms` of all frames, `keyframe_flow_ms` of keyframes."""
    return f"{kind}_{stage.replace(' ', '_')}_ms"


_TIMES = (
    *(Column(f"{stage}, ms", _stage_figure("stage", stage), 2) for stage in _STAGES),
    *(Column(f"{stage}, ms a keyframe", _stage_figure("keyframe", stage), 2) for stage in _STAGES),
    Column("keyframe, ms", "keyframe_ms_mean", 2),
    Column("other frame, ms", "between_keyframes_ms_mean", 2),
)
"""Mean times of the stages of frames and of keyframes."""
_DENSE = (
    Column("measured points", "dense_measured_points", 0),
    Column("points", "dense_points", 0),
    Column("MB", "dense_megabytes", 2),
    Column("ms a keyframe", "dense_ms", 2),
    Column("occupied cells", "dense_occupied", 0),
    Column("free cells", "dense_free", 0),
    Column("side of a cell, m", "dense_side_m", 3),
)
"""The dense map, and its octree for OctoMap."""
COVERAGE = ("images", "tracked_of_all_percent", "matched_percent", "span_percent")
"""What else decides whether figures may be compared with published ones: images of the whole recording, and shares of
the frames, dropped ones too, that were tracked, and that were matched with ground truth; and of its time."""
_COLUMNS = {
    column.figure: column
    for column in (*ACCURACY, *RUNNING, *_OF_PROTOCOLS, *_TIMES, *_DENSE)
    if column.which != "range"
}
_FIGURES = (*_COLUMNS, *COVERAGE)


def column_of(figure: str, statistic: Statistic) -> Column:
    """Return the column of a figure, with a statistic of the runs.

    Raises:
        BenchmarkError: If there is no such figure.
    """
    if figure not in _COLUMNS:
        raise BenchmarkError(f"columns: unknown figure '{figure}'{nearest(figure, _COLUMNS)}")
    return _COLUMNS[figure]._replace(which=statistic)


def row_name(sequence: str, label: str) -> str:
    """Return the name of a row."""
    return f"{sequence}, {label}"


def rows_of(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Results by sequence and label: how many runs were planned, and the figures of those that are done.

    A row has `sequence`, `label`, `runs` (planned), `done`, `failed`, `problems` of those that failed, `unevaluated`
    (why runs that are done have no ATE, with how many), `notes` of the evaluations, `lacks_network` (whether they went
    without the network that their preset needs), and by the name of each figure its statistics, or `None`.
    """
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for result in results:
        groups.setdefault((result["sequence"], result["label"]), []).append(result)
    return [_row(sequence, label, group) for (sequence, label), group in groups.items()]


def with_shown_labels(results: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Results whose label says if they went without the network that their preset needs; `folder` is as it was."""
    return [_shown(result) for result in results]


def shown_label(label: str, *, lacks_network: bool) -> str:
    """A label as tables show it: with the remark that runs went without the network that their preset needs."""
    return f"{label} (without a network)" if lacks_network else label


def by_sequence(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Rows or results, by the name of the sequence they are of, in their order."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row["sequence"], []).append(row)
    return groups


def median_run(results: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Choose the run of median error, the better of two, from the finished results of one row."""
    ates = [np.inf if result["ate_rmse_m"] is None else result["ate_rmse_m"] for result in results]
    return results[int(np.argsort(ates, kind="stable")[(len(results) - 1) // 2])]


def figures_of(result: Mapping[str, Any]) -> dict[str, float | None]:
    """Every figure of a run that a table may show or a verdict needs, by name."""
    flat = {**(result["evaluation"] or {}), **(result.get("consistency") or {}), **result}
    if frames := flat.get("frames"):
        flat["tracked_of_all_percent"] = 100 * flat["tracked"] / frames
        if (matched := flat.get("num_matched")) is not None:
            flat["matched_percent"] = 100 * matched / frames
    for name in ("track_ms", "mask_age_frames", "keyframe_ms", "between_keyframes_ms"):
        short = name.removesuffix("_frames")
        flat |= {f"{short}_{measure}": value for measure, value in (result.get(name) or {}).items()}
    for kind, name in (("stage", "stage_ms"), ("keyframe", "keyframe_stage_ms")):
        flat |= {_stage_figure(kind, stage): times["mean"] for stage, times in (result.get(name) or {}).items()}
    flat |= _dense_figures(result.get("dense") or {})
    return {name: flat.get(name) for name in _FIGURES}


def _dense_figures(dense: Mapping[str, Any]) -> dict[str, float | None]:
    """Figures of the dense map of a run by name; none without one."""
    found = {f"dense_{name}": dense.get(name) for name in ("measured_points", "points", "megabytes")}
    found["dense_ms"] = (dense.get("ms_per_keyframe") or {}).get("mean")
    return found | {f"dense_{name}": value for name, value in (dense.get("cells") or {}).items()}


def columns_of(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> list[Column]:
    """The columns in which a row has a figure."""
    return [column for column in columns if any(row[column.figure] is not None for row in rows)]


def cell(row: Mapping[str, Any], column: Column) -> str:
    """The text of a row in a column, `-` if no run has the figure, or too few for the statistic."""
    spread = row[column.figure]
    if spread is None:
        return "-"
    which = ("least", "most") if column.which == "range" else (column.which,)
    if any(name not in spread for name in which):
        return "-"
    return " - ".join(f"{spread[name]:.{column.digits}f}" for name in which)


def _shown(result: Mapping[str, Any]) -> Mapping[str, Any]:
    folder = str(run_folder(result["sequence"], result["label"], result["seed"]))
    label = shown_label(result["label"], lacks_network=bool(result.get("lacks_network")))
    return {**result, "folder": folder, "label": label}


def _row(sequence: str, label: str, group: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    done = [result for result in group if result["status"] == "done"]
    failed = [result for result in group if result["status"] == "failed"]
    figures = [figures_of(result) for result in done]
    values = {name: [value for of_run in figures if (value := of_run[name]) is not None] for name in _FIGURES}
    notes = (note for result in done for note in (result["evaluation"] or {}).get("notes", ()))
    return {
        "sequence": sequence,
        "label": label,
        "runs": len(group),
        "done": len(done),
        "failed": len(failed),
        "problems": sorted({result["problem"] for result in failed}),
        "unevaluated": Counter(
            result.get("evaluation_problem") or "not evaluated" for result in done if result["ate_rmse_m"] is None
        ),
        "notes": list(dict.fromkeys(notes)),
        "lacks_network": any(result.get("lacks_network") for result in done),
        **{name: _spread(of_it) for name, of_it in values.items()},
    }


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    """Statistics by the names of `Statistic`."""
    if not values:
        return None
    least, *between, most = sorted(values) if len(values) > 1 else (*values, *values)
    found = {"median": float(np.median(values)), "least": float(least), "most": float(most)}
    found["mean"] = float(np.mean(values))
    return found | ({"trimmed_mean": float(np.mean(between))} if len(values) >= FEWEST_TO_TRIM else {})
