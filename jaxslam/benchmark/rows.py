"""What the runs of a sequence have in common: a row of a table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

SUMMED_UP = (
    "ate_rmse_m",
    "ate_sim3_rmse_m",
    "rpe_trans_m_per_s",
    "rpe_rot_deg_per_s",
    "tracked_percent",
    "dropped_percent",
    "first_loss_s",
    "relocalised",
    "flow_ratio_median",
    "flow_ratio_p95",
    "flow_ratio_max",
)
"""Figures of a run of which a row has the median and the range."""


def rows_of(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Results by sequence and label: how many runs, and the figures of those that are done."""
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for result in results:
        groups.setdefault((result["sequence"], result["label"]), []).append(result)
    return [_row(sequence, label, group) for (sequence, label), group in groups.items()]


def _row(sequence: str, label: str, group: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    done = [result for result in group if result["status"] == "done"]
    row: dict[str, Any] = {
        "sequence": sequence,
        "label": label,
        "runs": len(group),
        "done": len(done),
        "problems": sorted({result["problem"] for result in group if result["problem"]}),
    }
    for name in SUMMED_UP:
        values = [value for result in done if (value := result.get(name)) is not None]
        row[name] = _spread(values)
    return row


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    """Median and range."""
    if not values:
        return None
    return {"median": float(np.median(values)), "least": float(min(values)), "most": float(max(values))}
