"""Checks of what `Slam` is made of and run on: types first, then whether map, recording and camera fit together."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from jaxslam.config.schema import Config
from jaxslam.errors import ConfigError, DatasetError, MapFileError
from jaxslam.map.types import Map
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.camera_difference import difference_of_cameras
from jaxslam.sensors.imu import ImuSheet
from jaxslam.sensors.motion_prior import MotionPrior
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.slam.input_warnings import InputWarnings

_T = TypeVar("_T")

_OF_RECORDING = ("camera", "timestamps_ns", "__len__", "__getitem__")


def check_arguments(
    camera: object,
    config: object,
    slam_map: object,
    detectors: Mapping[str, object],
    imu: object,
    *,
    localize_only: bool,
) -> None:
    """Refuse arguments of `Slam` that have the wrong type or do not go together.

    Args:
        camera: Expected to be a `Camera`.
        config: Expected to be a `Config`, or `None`.
        slam_map: Expected to be a `Map` of a camera of the same image size, or `None`.
        detectors: Detectors by the name of their argument; each is expected to be callable, or `None`.
        imu: Expected to be an `ImuSheet`, or `None`.
        localize_only: Whether the map stays as it is.

    Raises:
        TypeError: If an argument has the wrong type.
        MapFileError: If the map is of a camera of another image size.
        ConfigError: If `localize_only` is set without a map, or with an empty one.
    """
    camera = _require("camera", camera, Camera, _hint_of_camera(camera))
    if config is not None:
        _require("config", config, Config, _hint_of_config(config))
    for name, detector in detectors.items():
        if detector is not None and not callable(detector):
            raise TypeError(f"{name}: expected a callable that takes an image, got {type(detector).__name__}")
    if imu is not None and not isinstance(imu, ImuSheet):
        hint = "; read_imu_sheet(path) reads a data sheet" if isinstance(imu, str | Path) else ""
        raise TypeError(f"imu: expected a jaxslam.ImuSheet, got {type(imu).__name__}{hint}")
    if slam_map is not None:
        slam_map = _require("slam_map", slam_map, Map, "; Slam.load(path) reads a map file")
        _check_size(slam_map.camera, camera)
    if localize_only and (slam_map is None or not len(slam_map.ids)):
        got = "no map" if slam_map is None else "a map without keyframes"
        raise ConfigError(
            f"localize_only: needs the map to localize in: map=, or Slam.load(path, localize_only=True); got {got}"
        )


def check_prior(prior: object) -> None:
    """Refuse what is no motion prior.

    Raises:
        TypeError: If it is neither a `MotionPrior` nor `None`.
    """
    if prior is not None and not isinstance(prior, MotionPrior):
        hint = "; MotionPrior(T_last_cam, covariance)"
        raise TypeError(f"prior: expected a jaxslam.MotionPrior, got {type(prior).__name__}{hint}")


def warn_of_other_camera(map_camera: Camera, camera: Camera, warnings: InputWarnings) -> None:
    """Warn if a map was made with a camera that projects differently, by more than a new calibration would."""
    if difference := difference_of_cameras(map_camera, camera):
        warnings.warn(
            "map camera",
            f"camera: expected the map's, '{map_camera.name}', got '{camera.name}': {difference};"
            " poses in this map are wrong if the map was made with the camera in use",
        )


def check_recording(dataset: object, camera: Camera) -> None:
    """Refuse what is no recording of a camera.

    Args:
        dataset: Expected to have what `jaxslam.datasets.Dataset` has, ground truth and name apart.
        camera: The tracker's camera.

    Raises:
        DatasetError: If it is no recording, or one of another camera.
    """
    if missing := [name for name in _OF_RECORDING if not hasattr(dataset, name)]:
        raise DatasetError(
            "dataset: expected a recording, such as open_dataset(path), got"
            f" {type(dataset).__name__} without {', '.join(missing)}; give single frames to Slam.track"
        )
    given = dataset.camera  # pyright: ignore[reportAttributeAccessIssue]
    if not isinstance(given, Camera):
        raise DatasetError(f"dataset.camera: expected a Camera, got {type(given).__name__}")
    if difference := difference_of_cameras(camera, given):
        raise DatasetError(
            f"dataset.camera: expected the tracker's camera, '{camera.name}', got '{given.name}': {difference}"
        )


def _require(name: str, value: object, kind: type[_T], hint: str) -> _T:
    if not isinstance(value, kind):
        raise TypeError(f"{name}: expected a jaxslam.{kind.__name__}, got {type(value).__name__}{hint}")
    return value


def _hint_of_camera(given: object) -> str:
    if isinstance(given, RectifiedPair):
        return "; give its .camera, and frames of its .of(timestamp_ns, left, right)"
    return "; Camera.load takes a name or a file" if isinstance(given, str) else ""


def _hint_of_config(given: object) -> str:
    if isinstance(given, str):
        return f"; load_config({given!r}) takes a preset's name" if len(given) < 40 else ""
    return "; load_config(overrides=['run.deterministic=false']) changes single settings"


def _check_size(map_camera: Camera, camera: Camera) -> None:
    if (map_camera.width, map_camera.height) != (camera.width, camera.height):
        raise MapFileError(
            f"map: expected one of a camera of {camera.width}x{camera.height} pixels,"
            f" got {map_camera.width}x{map_camera.height}"
        )
