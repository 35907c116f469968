"""Export the map for other programs: a point cloud, a COLMAP model, and the trajectory of the keyframes.

Submaps have no common frame, so each export holds one of them: by default the one with most keyframes.
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np

from jaxslam.errors import MapFileError
from jaxslam.geometry.se3 import inverse, rotate
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.ply_file import write_ply_points
from jaxslam.map.point_records import observations_at, points_at, rows
from jaxslam.map.types import Keyframe, Map, point_submaps
from jaxslam.sensors.camera import Camera
from jaxslam.trajectory.trajectory import Trajectory, write_tum

PathLike: TypeAlias = str | os.PathLike[str]

_UNKNOWN_GRAY = 128
_KEYFRAME_RGB = (255, 128, 0)
_COLMAP_CENTER = 0.5
"""Coordinate of the center of the top-left pixel in COLMAP, pixels; here it is 0."""


def write_ply(path: PathLike, slam_map: Map, submap: int | None = None, *, keyframes: bool = False) -> None:
    """Write the points as a binary PLY file: position in meters, gray value, weight, and number of observations.

    Args:
        path: Path of the file to write; the file appears whole or not at all.
        slam_map: The map.
        submap: Number of the submap; by default the one with most keyframes.
        keyframes: Whether to add the keyframe positions as orange points, with the number of points they observe.

    Raises:
        MapFileError: If the file cannot be written, there is no such submap, or an image cannot be decoded.
    """
    part = one_submap(slam_map, submap)
    points, colors = part.points.X_world.T, np.repeat(_grays(part)[:, None], 3, axis=1)
    weights, observations = part.points.weight, _counts(part.points.ids, part.observations.point)
    if keyframes:
        centers = part.T_world_cam[:, 4:]
        points = np.concatenate([points, centers])
        colors = np.concatenate([colors, np.full((len(centers), 3), _KEYFRAME_RGB, np.uint8)])
        weights = np.concatenate([weights, np.ones(len(centers))])
        observations = np.concatenate([observations, _counts(part.ids, part.observations.keyframe)])
    write_ply_points(path, points, colors, weight=weights, observations=observations)


def write_colmap(folder: PathLike, slam_map: Map, submap: int | None = None) -> None:
    """Write a COLMAP model: `sparse/0/{cameras,images,points3D}.txt` and `images/*.png` in a folder.

    The camera is a pinhole without distortion, the pixels are those of such a camera (`Observations.uv`), and the
    images are undistorted. The residuals are then the same as in the map, where rolling shutter and distortion are
    corrected in the pixels, and dense methods can use the model directly. COLMAP measures pixels from the corner of the
    image, so all coordinates are half a pixel larger than here. Ids are those of the map plus one. Points without
    observations are left out.

    Args:
        folder: Folder to write to; it is created if missing. Files of an earlier export are replaced one by one.
        slam_map: The map.
        submap: Number of the submap; by default the one with most keyframes.

    Raises:
        MapFileError: If a file cannot be written, there is no such submap, or an image cannot be decoded.
    """
    part = one_submap(slam_map, submap)
    observed = np.isin(part.points.ids, part.observations.point)
    order = np.lexsort((part.observations.point, part.observations.keyframe))
    part = part.with_arrays(points_at(part.points, observed), observations_at(part.observations, order))
    model, images = Path(folder) / "sparse" / "0", Path(folder) / "images"
    for path in (model, images):
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MapFileError(f"{path}: cannot be made: {error}") from error
    for keyframe in part.keyframes:
        png = _undistorted(keyframe, part.camera)
        write_atomically(images / _image_name(keyframe.id), png, MapFileError)
    for name, lines in (
        ("cameras", _camera_lines(part.camera)),
        ("images", _image_lines(part)),
        ("points3D", _point_lines(part)),
    ):
        write_atomically(model / f"{name}.txt", "".join(f"{line}\n" for line in lines).encode(), MapFileError)


def write_keyframe_trajectory(path: PathLike, slam_map: Map, submap: int | None = None) -> None:
    """Write the poses of the keyframes in the TUM format, in the order of time.

    Raises:
        MapFileError: If there is no such submap.
        TrajectoryError: If the file cannot be written.
    """
    part = one_submap(slam_map, submap)
    stamps = np.array([keyframe.timestamp_ns for keyframe in part.keyframes], np.int64)
    order = np.argsort(stamps, kind="stable")
    write_tum(path, Trajectory(stamps[order], part.T_world_cam[order]))


def one_submap(slam_map: Map, submap: int | None = None) -> Map:
    """Extract one submap; an empty map is returned unchanged.

    Args:
        slam_map: The map.
        submap: Number of the submap; by default the one with most keyframes.

    Raises:
        MapFileError: If there is no such submap.
    """
    numbers, counts = np.unique(slam_map.submap, return_counts=True)
    if submap is None:
        if not len(numbers):
            return slam_map
        submap = int(numbers[np.argmax(counts)])
    if submap not in numbers:
        raise MapFileError(f"submap: expected one of {numbers.tolist()}, got {submap}")
    inside = slam_map.submap == submap
    seen = inside[rows(slam_map.ids, slam_map.observations.keyframe)]
    points = points_at(slam_map.points, point_submaps(slam_map) == submap)
    return slam_map.with_arrays(points, observations_at(slam_map.observations, seen))._replace(
        keyframes=tuple(keyframe for keyframe, own in zip(slam_map.keyframes, inside, strict=True) if own),
        ids=slam_map.ids[inside],
        T_world_cam=slam_map.T_world_cam[inside],
        parent=slam_map.parent[inside],
        submap=slam_map.submap[inside],
    )


def _counts(ids: np.ndarray, mentioned: np.ndarray) -> np.ndarray:
    """Count how often each of the ascending ids occurs in `mentioned`."""
    return np.bincount(rows(ids, mentioned), minlength=len(ids))


def _decoded(keyframe: Keyframe) -> np.ndarray:
    data = np.frombuffer(keyframe.image_file, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if image is None:
        raise MapFileError(f"keyframe {keyframe.id}: its image cannot be decoded")
    return image


def _grays(slam_map: Map) -> np.ndarray:
    """Return the `(p,)` gray value of each point in the first keyframe that observes it."""
    grays = np.full(len(slam_map.points.ids), _UNKNOWN_GRAY, np.uint8)
    points, first = np.unique(slam_map.observations.point, return_index=True)
    seen = observations_at(slam_map.observations, first)
    for keyframe in slam_map.keyframes:
        own = seen.keyframe == keyframe.id
        if own.any():
            image = _decoded(keyframe)
            u, v = np.rint(seen.uv_raw[:, own]).astype(np.int64)
            u, v = np.clip(u, 0, image.shape[1] - 1), np.clip(v, 0, image.shape[0] - 1)
            grays[rows(slam_map.points.ids, points[own])] = image[v, u]
    return grays


def _undistorted(keyframe: Keyframe, camera: Camera) -> bytes:
    """Return the undistorted image as PNG; black where the distorted image has no data."""
    image = _decoded(keyframe)
    if any(camera.distortion):
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        image = cv2.undistort(image, K, np.array(camera.distortion))
    return cv2.imencode(".png", image)[1].tobytes()


def _image_name(keyframe_id: int) -> str:
    return f"{keyframe_id:06d}.png"


def _camera_lines(camera: Camera) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] as fx, fy, cx, cy"
    center = f"{camera.cx + _COLMAP_CENTER} {camera.cy + _COLMAP_CENTER}"
    yield f"1 PINHOLE {camera.width} {camera.height} {camera.fx} {camera.fy} {center}"


def _image_lines(slam_map: Map) -> Iterator[str]:
    """Yield two lines for each keyframe: its pose (world to camera) and its pixels."""
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "# POINTS2D[] as (X, Y, POINT3D_ID)"
    us, vs = (slam_map.observations.uv.astype(np.float64) + _COLMAP_CENTER).tolist()
    points = (slam_map.observations.point + 1).tolist()
    poses = inverse(slam_map.T_world_cam).tolist()
    for number, pose, start, end in zip(slam_map.ids.tolist(), poses, *_bounds(slam_map), strict=True):
        yield f"{number + 1} {_words(pose)} 1 {_image_name(number)}"
        yield " ".join([f"{us[row]} {vs[row]} {points[row]}" for row in range(start, end)])


def _point_lines(slam_map: Map) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    point = rows(slam_map.points.ids, slam_map.observations.point)
    counts = np.bincount(point, minlength=len(slam_map.points.ids))
    errors = (np.bincount(point, _pixel_errors(slam_map), len(counts)) / counts).tolist()
    entries = _track_entries(slam_map)[np.argsort(point, kind="stable")].tolist()
    ends = np.cumsum(counts)
    grays, places = _grays(slam_map).tolist(), slam_map.points.X_world.T.tolist()
    for row, (start, end) in enumerate(zip((ends - counts).tolist(), ends.tolist(), strict=True)):
        track = " ".join([f"{image} {index}" for image, index in entries[start:end]])
        color = " ".join([str(grays[row])] * 3)
        yield f"{slam_map.points.ids[row] + 1} {_words(places[row])} {color} {errors[row]} {track}"


def _track_entries(slam_map: Map) -> np.ndarray:
    """Return the `(s, 2)` image id of each observation, and the index of its pixel in that image."""
    starts = np.repeat(_bounds(slam_map)[0], _counts(slam_map.ids, slam_map.observations.keyframe))
    return np.column_stack([slam_map.observations.keyframe + 1, np.arange(len(starts)) - starts])


def _bounds(slam_map: Map) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the end row of each keyframe's observations, which must be sorted by keyframe."""
    return np.searchsorted(slam_map.observations.keyframe, slam_map.ids), np.searchsorted(
        slam_map.observations.keyframe, slam_map.ids, "right"
    )


def _pixel_errors(slam_map: Map) -> np.ndarray:
    """Return the `(s,)` reprojection errors of the observations, pixels."""
    T_cam_world = inverse(slam_map.T_world_cam)[rows(slam_map.ids, slam_map.observations.keyframe)]
    X_world = slam_map.points.X_world[:, rows(slam_map.points.ids, slam_map.observations.point)]
    u, v = slam_map.camera.project((rotate(T_cam_world, X_world.T) + T_cam_world[:, 4:]).T)
    return np.hypot(u - slam_map.observations.uv[0], v - slam_map.observations.uv[1])


def _words(numbers: Sequence[float]) -> str:
    """Format floats as the shortest text that reads back to the same values."""
    return " ".join([str(number) for number in numbers])
