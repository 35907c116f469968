"""The map file: a NumPy `.npz` archive without pickles or compression, which `numpy.load` can open too.

Its first member, `header.json`, holds

    format           "jaxslam map"
    version          3
    camera           the fields of `jaxslam.Camera`, by name
    counts           number of keyframes k, points p, observations s, loops l, culled keyframes c, features n of all
                     keyframes together, and bytes b of all images together
    next_keyframe    next id of a keyframe
    next_point       next id of a point

The others are arrays, each `NAME.npy`, little-endian, in C order:

    keyframes.ids                  int64    (k)        ascending
    keyframes.T_world_cam          float64  (k, 7)     qw qx qy qz x y z, meters
    keyframes.parent               int64    (k)        id in the spanning tree; -1 for the first of a submap
    keyframes.submap               int32    (k)
    keyframes.timestamp_ns         int64    (k)        nanoseconds
    keyframes.feature_offsets      int64    (k + 1)    the features of keyframe i are offsets[i] to offsets[i + 1]
    keyframes.image_offsets        int64    (k + 1)    the same for the bytes of its image
    features.uv_raw                float32  (2, n)     pixels of the distorted image
    features.uv                    float32  (2, n)     pixels of an ideal pinhole camera
    features.depth                 float32  (n)        meters; 0 unknown
    features.octave                uint8    (n)        level of the scale pyramid
    features.angle                 float32  (n)        radians, from u towards v
    features.descriptor            uint8    (n, 32)    ORB
    images.files                   uint8    (b)        one gray image a keyframe, JPEG or PNG
    points.ids                     int64    (p)        ascending
    points.X_world                 float64  (3, p)     meters
    points.weight                  float32  (p)        0 to 1
    points.descriptor              uint8    (p, 32)    ORB; zeros for none
    points.has_descriptor          bool     (p)        whether there is a descriptor
    points.reference_keyframe      int64    (p)        id of a keyframe
    points.state                   int8     (p)        0 static, 1 blocked, 2 occluded; not in version 1: 0 there
    observations.keyframe          int64    (s)        id
    observations.point             int64    (s)        id
    observations.feature           int32    (s)        index in the keyframe; -1 for none
    observations.uv_raw            float32  (2, s)     pixels of the distorted image
    observations.uv                float32  (2, s)     pixels of an ideal pinhole camera
    observations.depth             float32  (s)        meters; 0 unknown
    observations.sigma_px          float32  (s)        pixels
    observations.weight            float32  (s)        0 to 1
    loops.source                   int64    (l)        id of a keyframe
    loops.target                   int64    (l)        id of a keyframe
    loops.T_source_target          float64  (l, 7)     qw qx qy qz x y z, meters
    loops.information              float64  (l, 6, 6)  inverse covariance, tangent translation first
    culled.ids                     int64    (c)        keyframes that were dropped
    culled.anchor                  int64    (c)        id of the keyframe relative to which each pose is stored
    culled.T_anchor_keyframe       float64  (c, 7)     qw qx qy qz x y z, meters

Any change of these is a new version.
"""

import ast
import dataclasses
import json
import math
import os
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeAlias

import numpy as np

from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.errors import JaxSlamError, MapFileError, one_line
from jaxslam.features.orb import Features
from jaxslam.io.atomic_files import replacing
from jaxslam.map.contents import MapContents
from jaxslam.map.point_records import MapPoints, Observations
from jaxslam.map.types import Culled, Keyframe, Loops, Map
from jaxslam.map.validate import ArrayField, array_fields, problems
from jaxslam.sensors.camera import Camera

FORMAT = "jaxslam map"
VERSION = 4
READABLE = (1, 2, 3, 4)
"""Versions that `load_map` reads."""

_SINCE = {"points.state": 2}
"""The first version with an array, if not version 1; in older files the array is missing and read as zeros."""

_BEFORE_VERSION_4 = {"images.files": "images.png"}
"""Names of arrays before version 4."""

_BEFORE_VERSION_3 = {
    "features.uv_raw": "features.seen_uv",
    "points.has_descriptor": "points.recognisable",
    "points.reference_keyframe": "points.made_by",
}
"""Names of arrays before version 3, in which `observations` were also called `sightings`."""

_COUNTS = {
    "k": "keyframes",
    "p": "points",
    "s": "observations",
    "l": "loops",
    "c": "culled",
    "n": "features",
    "b": "image_bytes",
}
_RECORDS = {"features": Features, "points": MapPoints, "observations": Observations, "loops": Loops, "culled": Culled}
_HEADER = "header.json"
_MAX_HEADER_BYTES = 1 << 16
_MAX_ARRAY_HEADER_BYTES = 1 << 10
_END_BYTES = 22
"""Size of the end record of a zip archive without a comment, bytes."""
_DAMAGE = (zipfile.BadZipFile, EOFError, ValueError, KeyError, RuntimeError, struct.error)
"""Exceptions besides `OSError` that reading an archive of arbitrary bytes may raise."""


_Count: TypeAlias = Annotated[int, Range(at_least=0, at_most=4 * 10**18)]


@dataclass(frozen=True)
class _Counts(ValidatedConfig):
    """Lengths of the arrays in a file."""

    _error: ClassVar[type[JaxSlamError]] = MapFileError

    keyframes: _Count
    points: _Count
    observations: _Count
    loops: _Count
    culled: _Count
    features: _Count
    image_bytes: _Count


@dataclass(frozen=True)
class _Header(ValidatedConfig):
    """The first member of a file."""

    _error: ClassVar[type[JaxSlamError]] = MapFileError

    format: str
    version: int
    camera: Camera
    counts: _Counts
    next_keyframe: _Count
    next_point: _Count

    @property
    def lengths(self) -> dict[str, int]:
        """Lengths of the dimensions of the arrays, by their letters."""
        return {letter: getattr(self.counts, name) for letter, name in _COUNTS.items()}


def save_map(path: str | os.PathLike[str], slam_map: Map) -> None:
    """Write a map file; it appears whole or not at all, and the same map gives the same bytes.

    Raises:
        MapFileError: If the file cannot be written, or the map is invalid.
    """
    if wrong := problems(slam_map):
        raise MapFileError(f"{path}: not written: {_first(wrong)}")
    arrays = _arrays(slam_map)
    with replacing(path, MapFileError) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        archive.writestr(zipfile.ZipInfo(_HEADER), json.dumps(_header(slam_map, arrays), indent=1))
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")  # dated 1980, so that equal maps give equal bytes
            member.file_size = array.nbytes
            with archive.open(member, "w") as file:
                np.lib.format.write_array(file, array, version=(1, 0), allow_pickle=False)


def load_map(path: str | os.PathLike[str]) -> Map:
    """Read a map file that `save_map` wrote; all numbers are restored exactly.

    Raises:
        MapFileError: If the file is missing, empty, damaged, of another format or version, or the map is invalid.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _check_ends(archive, Path(path))
            header = _read_header(archive)
            arrays = _read_arrays(archive, header, Path(path).stat().st_size)
        return _assembled(header, arrays)
    except MapFileError as error:
        raise MapFileError(f"{path}: {one_line(error)}") from None
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise MapFileError(f"{path}: {one_line(_damage(Path(path), error))}") from error


def _layout() -> dict[str, ArrayField]:
    """Return the type and shape of each array of a file."""
    layout = {f"keyframes.{name}": field for name, field in array_fields(Map).items()}
    layout["keyframes.timestamp_ns"] = ArrayField(np.dtype(np.int64), ("k",))
    layout["keyframes.feature_offsets"] = layout["keyframes.image_offsets"] = ArrayField(np.dtype(np.int64), ("k+1",))
    for prefix, record in _RECORDS.items():
        layout |= {f"{prefix}.{name}": field for name, field in array_fields(record).items()}
    return layout | {"images.files": ArrayField(np.dtype(np.uint8), ("b",))}


def _header(slam_map: Map, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    lengths = {
        "k": len(slam_map.ids),
        "p": len(slam_map.points.ids),
        "s": len(slam_map.observations.point),
        "l": len(slam_map.loops.source),
        "c": len(slam_map.culled.ids),
        "n": len(arrays["features.octave"]),
        "b": len(arrays["images.files"]),
    }
    return {
        "format": FORMAT,
        "version": VERSION,
        "camera": dataclasses.asdict(slam_map.camera),
        "counts": {_COUNTS[letter]: length for letter, length in lengths.items()},
        "next_keyframe": slam_map.next_keyframe,
        "next_point": slam_map.next_point,
    }


def _arrays(slam_map: Map) -> dict[str, np.ndarray]:
    """Return the arrays of a file by name, in the order of the file."""
    features = [keyframe.features for keyframe in slam_map.keyframes]
    images = [keyframe.image_file for keyframe in slam_map.keyframes]
    keyframes = {
        **slam_map._asdict(),
        "timestamp_ns": np.array([keyframe.timestamp_ns for keyframe in slam_map.keyframes], np.int64),
        "feature_offsets": _offsets([len(one.octave) for one in features]),
        "image_offsets": _offsets([len(image) for image in images]),
    }
    records = {
        "keyframes": keyframes,
        "features": _joined(features),
        "images": {"files": np.frombuffer(b"".join(images), np.uint8)},
        "points": slam_map.points._asdict(),
        "observations": slam_map.observations._asdict(),
        "loops": slam_map.loops._asdict(),
        "culled": slam_map.culled._asdict(),
    }
    split = {name: name.split(".") for name in _layout()}
    return {name: np.ascontiguousarray(records[record][field]) for name, (record, field) in split.items()}


def _joined(features: list[Features]) -> dict[str, np.ndarray]:
    """Concatenate the features of all keyframes; works without keyframes too."""
    fields = array_fields(Features)
    none = {name: np.zeros(field.shape({"n": 0}), field.dtype) for name, field in fields.items()}
    return {
        name: np.concatenate([none[name], *(getattr(one, name) for one in features)], axis=field.dims.index("n"))
        for name, field in fields.items()
    }


def _offsets(lengths: list[int]) -> np.ndarray:
    return np.cumsum([0, *lengths], dtype=np.int64)


def _check_ends(archive: zipfile.ZipFile, path: Path) -> None:
    """Reject a file with bytes before or after the archive, which `zipfile` would ignore."""
    with path.open("rb") as file:
        file.seek(-_END_BYTES, os.SEEK_END)
        end = file.read()
    first = min((member.header_offset for member in archive.infolist()), default=0)
    if not end.startswith(b"PK\5\6") or end[-2:] != b"\0\0" or first != 0:
        raise MapFileError("is damaged: holds bytes before or behind the archive")


def _read_header(archive: zipfile.ZipFile) -> _Header:
    names = archive.namelist()
    if _HEADER not in names or archive.getinfo(_HEADER).file_size > _MAX_HEADER_BYTES:
        raise MapFileError(f"not a jaxslam map: an archive of {', '.join(names[:3]) or 'nothing'}")
    with _opened(archive, _HEADER) as file:
        header = json.loads(file.read())
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise MapFileError("not a jaxslam map: its header does not say so")
    version = header.get("version")
    if type(version) is not int or version not in READABLE:
        readable = ", ".join(str(number) for number in READABLE)
        raise MapFileError(f"expected a map file of version {readable}, got version {version!r}")
    return from_mapping(_Header, _with_present_names(header, version), "header")


def _with_present_names(header: dict[str, Any], version: int) -> dict[str, Any]:
    """Return a header with the names that the counts have in the latest version."""
    if not isinstance(header.get("counts"), dict):
        return header
    present = {_name_in_version(name, version): name for name in _COUNTS.values()}
    return header | {"counts": {present.get(name, name): count for name, count in header["counts"].items()}}


def _name_in_version(name: str, version: int) -> str:
    """Return the name of an array or a count in files of a version."""
    if version < 4:
        name = _BEFORE_VERSION_4.get(name, name)
    if version >= 3:
        return name
    return _BEFORE_VERSION_3.get(name, name.replace("observations", "sightings").replace("uv_raw", "seen_uv"))


def _read_arrays(archive: zipfile.ZipFile, header: _Header, size: int) -> dict[str, np.ndarray]:
    whole = _layout()
    layout = {name: field for name, field in whole.items() if _SINCE.get(name, 1) <= header.version}
    named = {name: _name_in_version(name, header.version) for name in layout}
    expected = {_HEADER, *(f"{name}.npy" for name in named.values())}
    if sorted(archive.namelist()) != sorted(expected):
        odd = ", ".join(sorted(expected ^ set(archive.namelist()))) or "one twice"
        raise MapFileError(f"unknown or missing members: {odd}")
    lengths = header.lengths | {"k+1": header.lengths["k"] + 1}
    shapes = {name: field.shape(lengths) for name, field in layout.items()}
    announced = sum(layout[name].dtype.itemsize * math.prod(shape) for name, shape in shapes.items())
    if announced > size:
        raise MapFileError(f"announces {announced} bytes of arrays in a file of {size}")
    arrays = {name: _read_array(archive, named[name], layout[name].dtype, shape) for name, shape in shapes.items()}
    missing = {name: whole[name] for name in whole.keys() - layout.keys()}
    return arrays | {name: np.zeros(field.shape(lengths), field.dtype) for name, field in missing.items()}


def _read_array(archive: zipfile.ZipFile, name: str, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    with _opened(archive, f"{name}.npy") as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise MapFileError(f"{name}: expected an array in version 1.0 of NumPy's format")
        found_shape, by_column, found_dtype = _read_array_header(file, name)
        data = file.read()  # to the end, because the checksum is compared there
    if (found_shape, found_dtype) != (shape, dtype) or (by_column and len(shape) > 1):
        raise MapFileError(f"{name}: expected {dtype} {shape}, got {found_dtype} {found_shape}")
    if len(data) != dtype.itemsize * math.prod(shape):
        raise MapFileError(f"{name}: expected {dtype} {shape}, got {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape).copy()


def _read_array_header(file: zipfile.ZipExtFile, name: str) -> tuple[Any, Any, np.dtype]:
    """Read shape, Fortran order and type from a header of NumPy's format 1.0; NumPy would first try to repair it."""
    text = file.read(int.from_bytes(file.read(2), "little"))
    try:
        header = ast.literal_eval(text.decode("ascii")) if len(text) <= _MAX_ARRAY_HEADER_BYTES else {}
        return header["shape"], header["fortran_order"], np.dtype(str(header["descr"]))
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError):
        raise MapFileError(f"{name}: expected the header of a NumPy array, got {text!r:.40}") from None


def _opened(archive: zipfile.ZipFile, name: str) -> zipfile.ZipExtFile:
    """Open an uncompressed member, which takes no more memory than space in the file."""
    member = archive.getinfo(name)
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise MapFileError(f"{name}: expected no compression")
    return archive.open(member)  # pyright: ignore[reportReturnType] - typeshed says IO[bytes]


def _assembled(header: _Header, arrays: dict[str, np.ndarray]) -> Map:
    features = [
        Features(*columns)
        for columns in zip(*(_features(arrays, name) for name in array_fields(Features)), strict=True)
    ]
    images = [part.tobytes() for part in _split(arrays, "images.files", "keyframes.image_offsets")]
    ids, stamps = arrays["keyframes.ids"].tolist(), arrays["keyframes.timestamp_ns"].tolist()
    made = Map(
        camera=header.camera,
        keyframes=tuple(map(Keyframe, ids, stamps, features, images)),
        contents=MapContents(MapPoints(**_record(arrays, "points")), Observations(**_record(arrays, "observations"))),
        loops=Loops(**_record(arrays, "loops")),
        culled=Culled(**_record(arrays, "culled")),
        next_keyframe=header.next_keyframe,
        next_point=header.next_point,
        **{name: arrays[f"keyframes.{name}"] for name in array_fields(Map)},
    )
    if wrong := problems(made):
        raise MapFileError(f"the map is not whole: {_first(wrong)}")
    return made.in_blocks()


def _record(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name: arrays[f"{prefix}.{name}"] for name in array_fields(_RECORDS[prefix])}


def _features(arrays: dict[str, np.ndarray], name: str) -> list[np.ndarray]:
    """Split one array of features by keyframe."""
    axis = array_fields(Features)[name].dims.index("n")
    parts = _split(arrays, f"features.{name}", "keyframes.feature_offsets", axis)
    return [np.array(part, order="C") for part in parts]


def _split(arrays: dict[str, np.ndarray], name: str, offsets_name: str, axis: int = 0) -> list[np.ndarray]:
    """Split an array by keyframe."""
    offsets, whole = arrays[offsets_name], arrays[name]
    if offsets[0] != 0 or offsets[-1] != whole.shape[axis] or (np.diff(offsets) < 0).any():
        raise MapFileError(f"{offsets_name}: expected them to rise from 0 to {whole.shape[axis]}")
    return np.split(whole, offsets[1:-1], axis) if len(offsets) > 1 else []


def _damage(path: Path, error: Exception) -> str:
    with path.open("rb") as file:
        start = file.read(2)
    if not start:
        return "is empty"
    return f"is damaged or cut short: {error}" if start == b"PK" else "not a jaxslam map"


def _first(wrong: list[str]) -> str:
    return wrong[0] + (f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else "")
