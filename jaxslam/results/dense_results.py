"""Write the dense map of a run: points, octrees, a picture, and figures for the summary."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.dense.octomap_file import write_bt, write_ot
from jaxslam.dense.ply_file import write_points
from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.dense.render import write_picture
from jaxslam.slam.dense_thread import DenseMapping
from jaxslam.trajectory.trajectory import Trajectory

_POINTS = ("map.ply", "dense.png")
_OCTREES = ("map.bt", "map.ot")
DENSE_FILES = (*_POINTS, *_OCTREES)
"""All files of a dense map. Octrees are written only if some depth was measured."""
_PREFIX = "dense: "


def write_dense(
    folder: Path, dense: DenseMapping | None, path: Trajectory, ms: Mapping[str, np.ndarray]
) -> tuple[dict[str, Any] | None, tuple[str, ...]]:
    """Write the dense map.

    Args:
        folder: Existing folder for the files.
        dense: Dense mapping of the run; `None` if it was disabled.
        path: Trajectory of the camera, which the picture shows.
        ms: Durations of each stage in milliseconds. The stage `dense` is the dense map as a whole, and stages whose
            names begin with `dense: ` are its parts.

    Returns:
        figures: Figures for `summary.json`; `None` without a dense map.
        files: Names of the written files.

    Raises:
        MapFileError: If a file cannot be written.
    """
    if dense is None:
        return None, ()
    cloud = dense.cloud()
    write_points(folder / _POINTS[0], cloud)
    write_picture(folder / _POINTS[1], cloud, path.T_world_cam)
    figures, written = _figures(cloud, dense, ms), _POINTS
    if dense.sees_anything:
        cells = dense.cells()
        write_bt(folder / _OCTREES[0], cells)
        write_ot(folder / _OCTREES[1], cells)
        figures["cells"] = {
            "side_m": cells.cell_m,
            "occupied": int(np.count_nonzero(cells.known & (cells.log_odds >= 0))),
            "free": int(np.count_nonzero(cells.known & (cells.log_odds < 0))),
        }
        written = DENSE_FILES
    return figures, written


def _figures(cloud: DenseCloud, dense: DenseMapping, ms: Mapping[str, np.ndarray]) -> dict[str, Any]:
    made = dense.figures()
    return {
        "points": len(cloud.points),
        "key_points": int(cloud.is_key.sum()),
        "measured_points": made.measured,
        "share_of_measured": round(len(cloud.points) / max(made.measured, 1), 6),
        "megabytes": round(cloud.megabytes, 3),
        "working_megabytes": round(made.working_mb, 3),
        "voxel_m": cloud.voxel_m,
        "coarsened": made.coarsened,
        "keyframes": made.keyframes,
        "keyframes_passed_over": made.passed_over,
        "keyframes_frozen": made.frozen,
        "keyframes_moved": made.moved,
        "ms_per_keyframe": _times(ms.get("dense")),
        "stage_ms": {name.removeprefix(_PREFIX): _times(ms[name]) for name in ms if name.startswith(_PREFIX)},
        "cells": None,
    }


def _times(ms: np.ndarray | None) -> dict[str, float] | None:
    if ms is None or not len(ms):
        return None
    figures = {"mean": ms.mean(), "median": np.median(ms), "p95": np.percentile(ms, 95), "max": ms.max()}
    return {name: round(float(value), 3) for name, value in figures.items()}
