"""Results of runs as a benchmark leaves them, made by hand."""

from typing import Any


def done(sequence: str = "crowd", label: str = "static", seed: int = 0, **changes: Any) -> dict[str, Any]:
    """A run of all of Bonn `crowd` that went well, but for changes; those of `evaluation` are made to its figures."""
    figures = {
        "num_matched": 927,
        "coverage_percent": 99.0,
        "span_percent": 99.0,
        "rpe_trans_m_per_s": 0.03,
        "rpe_rot_deg_per_s": 0.7,
        "rpe_trans_m_per_frame": 0.01,
        "rpe_rot_deg_per_frame": 0.2,
        "kitti_trans_percent": None,
        "kitti_rot_deg_per_100m": None,
        "notes": [],
    }
    result = {
        "sequence": sequence,
        "label": label,
        "preset": label,
        "variant": "",
        "seed": seed,
        "status": "done",
        "problem": None,
        "frames": 927,
        "images": 928,
        "tracked": 927,
        "tracked_percent": 100.0,
        "dropped": 0,
        "dropped_percent": 0.0,
        "ate_rmse_m": 0.02,
        "ate_sim3_rmse_m": 0.019,
        "evaluation": figures,
        "evaluation_problem": None,
        "rate_hz": 30.0,
        "track_ms": None,
        "mask_age_frames": None,
        "model": None,
        "without_network": None,
        "lacks_network": False,
        "networks_sha256": {},
        "sources_sha256": "1",
        "data_sha256": "2",
        "camera_sha256": None,
        "commit": "abc",
        "versions": {"jaxslam": "0.1", "numpy": "2"},
        "cpu": "any",
        "cores": 2,
        "deterministic": True,
        "realtime": False,
    }
    evaluation = changes.pop("evaluation", {})
    return result | changes | {"evaluation": None if evaluation is None else figures | evaluation}


def not_done(status: str, problem: str | None = None, **changes: Any) -> dict[str, Any]:
    """A run that failed or was not made."""
    run = done(**changes)
    keys = ("sequence", "label", "preset", "variant", "seed")
    return {key: run[key] for key in keys} | {"status": status, "problem": problem}
