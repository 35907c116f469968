"""Files that describe two cameras before rectification, read into a `Rig`: formats of jaxslam, ORB-SLAM3 and Kalibr.

An example of jaxslam's own format:

left: {width: 752, height: 480, fx: 458.7, fy: 457.3, cx: 367.2, cy: 248.4, distortion: [-0.28, 0.07, 0.0002, 0.00002]}
right: {width: 752, height: 480, fx: 457.6, fy: 456.1, cx: 379.999, cy: 255.2}
T_left_right: [[1, 0, 0, 0.11], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]  # or qw qx qy qz x y z
fps: 20
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.config.validation import from_mapping
from jaxslam.errors import CameraError
from jaxslam.geometry.se3 import inverse
from jaxslam.geometry.so3 import quaternions
from jaxslam.io.yaml_files import read_mapping
from jaxslam.sensors.stereo_rig import Lens, LensModel, Rig

_PINHOLE = ("fx", "fy", "cx", "cy")
_LENS_OF_ORB_SLAM3: dict[str, tuple[LensModel, str]] = {
    "PinHole": ("radtan", "k1 k2 p1 p2 k3"),
    "KannalaBrandt8": ("equidistant", "k1 k2 k3 k4"),
}
_LENS_OF_KALIBR: dict[str, LensModel] = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "equidistant": "equidistant",
    "none": "radtan",
}
_FARTHEST_M = 1e6
_ROTATION_OFF = 0.01


def read_rig(path: Path) -> Rig:
    """Read two cameras and the transform between them.

    Args:
        path: The file. Its keys tell its format.

    Raises:
        CameraError: If the file is unreadable, lacks a required key, has an unknown one (jaxslam's format only), or
            the calibration is impossible.
    """
    raw = read_mapping(path, CameraError)
    if any(key.startswith("Camera2.") for key in raw):
        read = _of_orb_slam3
    elif "cam0" in raw or "cam1" in raw:
        read = _of_kalibr
    else:
        read = _own
    try:
        fields: dict[str, Any] = {"name": path.stem} | read(raw)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from None
    return from_mapping(Rig, fields, str(path))


def lens_of_kalibr(raw: Mapping[str, Any], place: str) -> Lens:
    """Read a camera as Kalibr and EuRoC's `sensor.yaml` write it: `intrinsics`, `distortion_model`, `resolution`.

    Args:
        raw: The keys and values of the camera.
        place: Prefix of the key in messages.

    Raises:
        CameraError: If a key is missing, the camera is not a pinhole, or its distortion model is unknown.
    """
    intrinsics = numbers(raw, "intrinsics", place, 4)
    width, height = numbers(raw, "resolution", place, 2)
    if raw.get("camera_model", "pinhole") != "pinhole":
        raise CameraError(f"{place}camera_model: expected 'pinhole', got {raw['camera_model']!r:.80}")
    model = str(raw.get("distortion_model", "none"))
    if model not in _LENS_OF_KALIBR:
        raise CameraError(f"{place}distortion_model: expected one of {', '.join(_LENS_OF_KALIBR)}, got '{model:.80}'")
    key = "distortion_coefficients" if "distortion_coefficients" in raw else "distortion_coeffs"
    terms = numbers(raw, key, place) if model != "none" else []
    fx, fy, cx, cy = intrinsics
    return Lens(int(width), int(height), fx, fy, cx, cy, tuple(terms), _LENS_OF_KALIBR[model])


def transform_of(value: object, place: str) -> np.ndarray:
    """Convert a pose to `(7,)` wxyz_xyz.

    Args:
        value: A 4 x 4 matrix, as rows, 16 numbers or OpenCV's `data`, or 7 numbers `qw qx qy qz x y z`.
        place: Name of the value in messages.

    Raises:
        CameraError: If the value has none of these forms, or is not a rigid transform.
    """
    content = value.get("data") if isinstance(value, Mapping) else value
    try:
        given = np.asarray(content, np.float64).ravel()
    except (TypeError, ValueError):
        given = np.zeros(0)
    usable = bool((np.abs(given) < _FARTHEST_M).all())  # false for NaN too
    if given.size == 7 and usable:
        return given
    if given.size != 16 or not usable:
        raise CameraError(f"{place}: expected a 4 x 4 matrix or qw qx qy qz x y z, got {content!r:.80}")
    M = given.reshape(4, 4)
    R = M[:3, :3]
    off = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(M[3] - [0, 0, 0, 1]).max())
    if off > _ROTATION_OFF or np.linalg.det(R) < 0:
        raise CameraError(f"{place}: expected a rotation, a translation and the row 0 0 0 1, got something else")
    return np.concatenate([quaternions(R[None])[0], M[:3, 3]])


def numbers(raw: Mapping[str, Any], key: str, place: str, count: int | None = None) -> list[float]:
    """Return the list of numbers under a key.

    Args:
        raw: The keys and values to read from.
        key: The key of the list.
        place: Prefix of the key in messages.
        count: The required length; `None` for any.

    Raises:
        CameraError: If there is no such list, or it has another length.
    """
    value = raw.get(key)
    is_number = lambda x: isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x)
    fits = isinstance(value, list) and all(map(is_number, value))
    if not fits or (count is not None and len(raw[key]) != count):
        what = "a list of numbers" if count is None else f"{count} numbers"
        raise CameraError(f"{place}{key}: expected {what}, got {value!r:.80}")
    return [float(x) for x in raw[key]]


def _own(raw: Mapping[str, Any]) -> dict[str, Any]:
    if "T_left_right" not in raw:
        return dict(raw)  # refused with all other keys that are missing
    return {**raw, "T_left_right": tuple(transform_of(raw["T_left_right"], "T_left_right").tolist())}


def _of_orb_slam3(raw: Mapping[str, Any]) -> dict[str, Any]:
    kind = str(raw.get("Camera.type", "PinHole"))
    if kind not in _LENS_OF_ORB_SLAM3:
        raise CameraError(f"Camera.type: expected one of {', '.join(_LENS_OF_ORB_SLAM3)}, got {kind!r:.80}")
    model, terms = _LENS_OF_ORB_SLAM3[kind]
    size = ("Camera.width", "Camera.height")
    pinholes = [f"{camera}.{name}" for camera in ("Camera1", "Camera2") for name in _PINHOLE]
    missing = [key for key in (*size, *pinholes, "Stereo.T_c1_c2") if key not in raw]
    if missing:
        raise CameraError(f"missing {', '.join(map(repr, missing))}")
    fields: dict[str, Any] = {"T_left_right": tuple(transform_of(raw["Stereo.T_c1_c2"], "Stereo.T_c1_c2").tolist())}
    for side, camera in (("left", "Camera1"), ("right", "Camera2")):
        of_lens: dict[str, Any] = {name: raw[f"{camera}.{name}"] for name in _PINHOLE}
        of_lens |= {"distortion": tuple(raw.get(f"{camera}.{term}", 0.0) for term in terms.split()), "model": model}
        fields[side] = Lens(raw["Camera.width"], raw["Camera.height"], **of_lens)
    for field, key in (("fps", "Camera.fps"), ("far_depth_baselines", "Stereo.ThDepth")):
        if key in raw:
            fields[field] = raw[key]
    return fields


def _of_kalibr(raw: Mapping[str, Any]) -> dict[str, Any]:
    for camera in ("cam0", "cam1"):
        if not isinstance(raw.get(camera), dict):
            raise CameraError(f"{camera}: expected `key: value` lines, got {raw.get(camera)!r:.80}")
    if "T_cn_cnm1" not in raw["cam1"]:
        raise CameraError("cam1.T_cn_cnm1: expected a 4 x 4 matrix, got none")
    T_right_left = transform_of(raw["cam1"]["T_cn_cnm1"], "cam1.T_cn_cnm1")
    return {
        "left": lens_of_kalibr(raw["cam0"], "cam0."),
        "right": lens_of_kalibr(raw["cam1"], "cam1."),
        "T_left_right": tuple(inverse(T_right_left).tolist()),
    }
