"""Camera files of jaxslam (flat YAML), ORB-SLAM2 and ORB-SLAM3, read into the fields of `Camera`.

The files of ORB-SLAM also hold settings of other modules (`ORBextractor.*`, `Viewer.*`); those are ignored.
In jaxslam's own format every key must be a field of `Camera`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxslam.errors import CameraError
from jaxslam.io.yaml_files import read_mapping

NEEDED = ("width", "height", "fx", "fy", "cx", "cy")
"""Fields that every camera file must give."""

_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_SHARED = {"width": "Camera.width", "height": "Camera.height", "fps": "Camera.fps"}
_ORB_SLAM2 = _SHARED | {
    **{field: f"Camera.{field}" for field in ("fx", "fy", "cx", "cy", *_DISTORTION)},
    "depth_scale_per_m": "DepthMapFactor",
    "baseline_px_m": "Camera.bf",
    "far_depth_baselines": "ThDepth",
}
_ORB_SLAM3 = _SHARED | {
    **{field: f"Camera1.{field}" for field in ("fx", "fy", "cx", "cy", *_DISTORTION)},
    "depth_scale_per_m": "RGBD.DepthMapFactor",
    "baseline_m": "Stereo.b",
    "far_depth_baselines": "Stereo.ThDepth",
}
_FISHEYE = "KannalaBrandt8"


def is_pair(raw: Mapping[str, Any]) -> bool:
    """Whether a camera file describes a stereo pair that is not rectified."""
    return any(key in ("left", "right", "cam0", "cam1") or key.startswith("Camera2.") for key in raw)


def read_camera_fields(path: Path) -> dict[str, Any]:
    """Read the values of a camera file, under the names of `Camera`'s fields; `Camera` checks them.

    Args:
        path: The file. Its keys tell its format.

    Raises:
        CameraError: If the file is unreadable, or lacks a required key of ORB-SLAM's formats.
    """
    raw = read_mapping(path, CameraError)
    if is_pair(raw):
        raise CameraError(f"{path}: expected one camera, got an unrectified pair (jaxslam.RectifiedPair.load reads it)")
    if any(key.startswith("Camera1.") for key in raw) or "File.version" in raw:
        values = _orb_slam(raw, _ORB_SLAM3, path)
    elif any(key.startswith("Camera.") for key in raw):
        values = _orb_slam(raw, _ORB_SLAM2, path)
    else:
        values = raw
    return {"name": path.stem} | values


def _orb_slam(raw: Mapping[str, Any], keys: Mapping[str, str], path: Path) -> dict[str, Any]:
    if raw.get("Camera.type") == _FISHEYE:
        raise CameraError(f"{path}: Camera.type: expected 'PinHole' or 'Rectified', got '{_FISHEYE}' (fisheye)")
    _check_needed(raw, keys, path)
    given = {field: raw[key] for field, key in keys.items() if key in raw}
    values = {field: given[field] for field in (*NEEDED, "fps", "baseline_m") if field in given}
    values["distortion"] = [given.get(term, 0.0) for term in _DISTORTION]
    if "Camera.RGB" in raw:
        values["color_order"] = "rgb" if raw["Camera.RGB"] else "bgr"
    if "depth_scale_per_m" in given:  # in both systems a factor of 0 means that depth is in meters
        values["depth_scale_per_m"] = given["depth_scale_per_m"] or 1.0
    return values | _lengths(given, keys, path)


def _lengths(given: Mapping[str, Any], keys: Mapping[str, str], path: Path) -> dict[str, float]:
    """Return baseline and far depth in meters: `Camera.bf` is baseline times fx, `ThDepth` counts baselines."""
    numbers = {
        field: _number(given[field], keys[field], path)
        for field in ("fx", "baseline_px_m", "baseline_m", "far_depth_baselines")
        if field in given
    }
    baseline = numbers.get("baseline_m")
    if "baseline_px_m" in numbers:
        baseline = numbers["baseline_px_m"] / numbers["fx"]
    if baseline is None:
        return {}
    far = numbers.get("far_depth_baselines")
    return {"baseline_m": baseline} | ({"far_depth_m": far * baseline} if far is not None else {})


def _number(value: object, key: str, path: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise CameraError(f"{path}: {key}: expected a number > 0, got {value!r:.80}")
    return float(value)


def _check_needed(raw: Mapping[str, Any], keys: Mapping[str, str], path: Path) -> None:
    missing = [keys[field] for field in NEEDED if keys[field] not in raw]
    if missing:
        raise CameraError(f"{path}: missing {', '.join(repr(key) for key in missing)}")
