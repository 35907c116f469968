"""The file of the learned cue's network: JSON with its layout, its weights and where they come from."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxslam_kernels.point_network import network_shapes
from jaxtyping import Float32

from jaxslam.errors import ModelError, brief_repr, one_line
from jaxslam.io.atomic_files import write_atomically

FORMAT, VERSION = "jaxslam point network", 2
POINT_FEATURES = (
    "anchor_px",
    "map_px",
    "flow_px",
    "anchor_sigmas",
    "map_sigmas",
    "flow_sigmas",
    "drift_px",
    "has_depth",
    "had_depth",
    "agrees",
    "trust",
)
"""Features of a point: its distance from where a static point would be, in pixels and in standard deviations of depth,
for a position measured up to half a second ago, the fused one and that of the last frame; how far the first two are
apart, in pixels; whether depth is measured here and in the frame before; whether it agrees with the coarse pose; and
the weight that the tracker gives it."""
GROUP_FEATURES = ("num_points", "memory")
"""Features of a region: how many points it has, and its weight in the frame before."""
PACKAGED = Path(__file__).with_name("learned_weights.json")
_DIGITS = 5
_MAX_BYTES, _MAX_HIDDEN = 1 << 20, 256


@dataclass(frozen=True)
class NetworkFile:
    """Content of the file of a network.

    Attributes:
        weights: Arrays of a `PointNetwork`, by name, float32.
        provenance: Where the weights come from: command, seed, worlds and figures of the training.
    """

    weights: Mapping[str, Float32[np.ndarray, "..."]]
    provenance: Mapping[str, Any]


def save_network(path: str | Path, weights: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
    """Write a network, rounded to five digits; the same weights give the same bytes.

    Args:
        path: File to write.
        weights: Arrays of a `PointNetwork`, by name.
        provenance: Where they come from, as JSON can hold it.

    Raises:
        ModelError: If the file cannot be written, or a weight is not finite or has a wrong shape.
    """
    arrays = {name: np.asarray(value, np.float32) for name, value in weights.items()}
    _check_shapes(arrays, str(path))
    content = {
        "format": FORMAT,
        "version": VERSION,
        "point_features": list(POINT_FEATURES),
        "group_features": list(GROUP_FEATURES),
        "provenance": dict(provenance),
        "weights": {name: _rounded(array.tolist()) for name, array in arrays.items()},
    }
    parts = [
        f" {json.dumps(key)}: {json.dumps(value, indent=1 if key == 'provenance' else None, allow_nan=False)}"
        for key, value in content.items()
    ]
    write_atomically(path, ("{\n" + ",\n".join(parts) + "\n}\n").encode(), ModelError)


def load_network(path: str | Path | None = None) -> NetworkFile:
    """Read a network.

    Args:
        path: File of `save_network`; by default the one that comes with jaxslam.

    Raises:
        ModelError: If the file is missing or damaged, or has another layout than this version of jaxslam.
    """
    path = PACKAGED if path is None else Path(path)
    content = _read(path)
    expected = {
        "format": FORMAT,
        "version": VERSION,
        "point_features": list(POINT_FEATURES),
        "group_features": list(GROUP_FEATURES),
    }
    for key, value in expected.items():
        if content.get(key) != value:
            raise ModelError(f"{path}: {key}: expected {brief_repr(value)}, got {brief_repr(content.get(key))}")
    for key in ("weights", "provenance"):
        if not isinstance(content.get(key), dict):
            raise ModelError(f"{path}: {key}: expected a mapping, got {brief_repr(content.get(key))}")
    arrays = {name: _array(value, f"{path}: weights.{name}") for name, value in content["weights"].items()}
    _check_shapes(arrays, str(path))
    return NetworkFile(arrays, content["provenance"])


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except OSError as failure:
        raise ModelError(f"{path}: cannot be read: {failure.strerror or failure}") from failure
    if len(data) > _MAX_BYTES:
        raise ModelError(f"{path}: expected the weights of the learned cue, at most {_MAX_BYTES} bytes, got more")
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as failure:
        raise ModelError(f"{path}: expected JSON, got a damaged or another file: {one_line(failure)}") from failure
    if not isinstance(content, dict):
        raise ModelError(f"{path}: expected a mapping, got {brief_repr(content)}")
    return content


def _array(value: Any, place: str) -> Float32[np.ndarray, "..."]:
    try:
        with np.errstate(over="ignore"):
            return np.asarray(value, np.float64).astype(np.float32)
    except (ValueError, TypeError, OverflowError) as failure:
        raise ModelError(f"{place}: expected numbers, got {brief_repr(value)}: {one_line(failure)}") from failure


def _check_shapes(arrays: Mapping[str, np.ndarray], place: str) -> None:
    """Check that arrays are those of a `PointNetwork` for the features of this version, and finite."""
    bias = arrays.get("embed_bias")
    num_hidden = 0 if bias is None or bias.ndim != 1 else len(bias)
    if not 1 <= num_hidden <= _MAX_HIDDEN:
        given = "nothing" if bias is None else bias.shape
        raise ModelError(f"{place}: weights.embed_bias: expected 1 to {_MAX_HIDDEN} numbers, got {given}")
    shapes = network_shapes(len(POINT_FEATURES), len(GROUP_FEATURES), num_hidden)
    if set(arrays) != set(shapes):
        raise ModelError(f"{place}: weights: expected {', '.join(shapes)}, got {', '.join(arrays)}")
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ModelError(f"{place}: weights.{name}: expected numbers {shape}, got {arrays[name].shape}")
        if not np.isfinite(arrays[name]).all():
            raise ModelError(f"{place}: weights.{name}: expected finite numbers, got some that are not")


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else value
