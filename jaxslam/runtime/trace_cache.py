"""Traces of programs are kept between processes, as XLA keeps what it compiles.

JAX finds compiled code on the disk by the program it has traced, so that every start traces. With traces kept too, the
tracker and its map are ready after 1.3 s instead of 5.1 (AMD EPYC, two cores). `jax.export` writes a trace; it is found
by what it was made from: function, sizes, static arguments, settings of JAX, and all sources.

A trace is a program, so that only folders of the user's own are read from. A file holds the SHA-256 of the rest, a line
of JSON with the structure of the result, and the program. Nothing in it is unpickled.
"""

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import json
import logging
import math
import platform
import sys
import time
from collections.abc import Callable, Iterable
from enum import Enum
from importlib import metadata, util
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import equinox as eqx
import jax
import numpy as np
from jax import export
from jax.core import Tracer

from jaxslam.errors import JaxSlamError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.folder_ownership import OWN_MODE, why_not_own

_log = logging.getLogger(__name__)

P = ParamSpec("P")
R = TypeVar("R")

_PACKAGES = ("jaxslam", "jaxslam_kernels")
"""Functions of these are known by their names and the hash of all their sources."""
_TRACED_WITH = ("jaxslam", "jax", "jaxlib", "equinox", "lineax", "optimistix", "jaxlie", "jax_dataclasses", "numpy")
_KEPT_DAYS = 30
"""What nothing asked for in that time is removed."""
_SETTLED_S = 5.0
"""Sources changed later than so long before jaxslam was loaded may not be those that were loaded."""

_loaded = time.time()


def cached_trace(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which `jax.jit` traces from the disk where it or another process has traced it before.

    To be put under `jax.jit`; called without it, it is the function itself. What is static may be numbers, text, flags,
    enumerations and functions of jaxslam, in tuples; with anything else, such as a function of the user's, it is traced
    every time. It cannot be differentiated.

    The same trace is compiled whether it was found or made, so that a first start gives the same digits as a later one.
    What a program from the disk gives is committed to its device, as by `jax.device_put(x, device)`; and a program that
    was compiled for arguments which are not is compiled again for some that are.

    Args:
        function: Pure function of jaxslam that takes arrays in pytrees and static arguments.
    """

    @functools.wraps(function)
    def traced(*args: P.args, **kwargs: P.kwargs) -> R:
        arrays, static = eqx.partition((args, kwargs), lambda leaf: isinstance(leaf, Tracer))
        leaves, tree = jax.tree.flatten(arrays)
        known = _key_of((function, *jax.tree.leaves(static)))
        if known is None or not leaves:
            return function(*args, **kwargs)
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in map(jax.typeof, leaves)]
        file = _file(f"{known} {jax.tree.structure((args, kwargs))} {tree} {shapes}")
        kept = None if file is None else _read(file)
        if kept is None:
            kept = _traced(function, shapes, tree, static)
            if file is not None:
                _write(file, kept)
        program, skeleton = kept
        return jax.tree.unflatten(jax.tree.structure(skeleton), export.deserialize(program).call(*leaves))

    return traced


_Kept = tuple[bytearray, Any]
"""A program of arrays in a row, and what it gives: numbers in a pytree."""


def _traced(function: Callable[..., Any], shapes: list[jax.ShapeDtypeStruct], tree: Any, static: Any) -> _Kept:
    skeleton = None

    def flat(*leaves: Any) -> list[Any]:
        nonlocal skeleton
        args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
        given, structure = jax.tree.flatten(function(*args, **kwargs))
        skeleton = jax.tree.unflatten(structure, range(len(given)))
        return given

    return export.export(jax.jit(flat))(*shapes).serialize(), skeleton


def _key_of(value: Any) -> str | None:
    """Text that says what a static value is; `None` if it cannot be told."""
    if isinstance(value, Enum):
        return f"{type(value).__module__}.{value!r}"
    is_number_type = isinstance(value, type) and value.__module__ in {"numpy", "jax.numpy"}
    if value is None or is_number_type or isinstance(value, bool | int | float | str | np.dtype):
        return repr(value)
    if isinstance(value, tuple | list):
        return _key_of_parts(f"{type(value).__module__}.{type(value).__qualname__}", value)
    if isinstance(value, functools.partial):
        return _key_of_parts("partial", (value.func, value.args, tuple(sorted(value.keywords.items()))))
    if inspect.isfunction(value):
        module = value.__globals__["__name__"]  # not `__module__`, which `functools.wraps` copies to a user's function
        if module.partition(".")[0] in _PACKAGES:
            name = f"{module}.{value.__qualname__}:{value.__code__.co_firstlineno}"
            held = [cell.cell_contents for cell in value.__closure__ or ()]
            return _key_of_parts(name, (held, value.__defaults__, tuple((value.__kwdefaults__ or {}).items())))
    return None


def _key_of_parts(name: str, values: Iterable[Any]) -> str | None:
    parts = [_key_of(value) for value in values]
    return None if None in parts else f"{name}({', '.join(cast(list[str], parts))})"


def _file(program: str) -> Path | None:
    """Return the file of a program; `None` if it is not kept."""
    folder: str | None = jax.config.values["jax_compilation_cache_dir"]
    sources = sources_hash()
    if not folder or not jax.config.values["jax_enable_compilation_cache"] or sources is None or " at 0x" in program:
        return None
    names = (name for name in sorted(jax.config.values) if not name.startswith("jax_persistent_cache"))
    settings = {name: getattr(jax.config, name, None) for name in names}
    text = f"{sources}\n{jax.default_backend()}\n{settings}\n{program}"
    return Path(folder) / "traces" / hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def sources_hash() -> str | None:
    """Hash the sources of jaxslam and the versions of what traces them; `None` if they may not be what was loaded."""
    versions = [platform.python_version(), *(f"{name} {metadata.version(name)}" for name in _TRACED_WITH)]
    digest = hashlib.sha256(" ".join(versions).encode())
    files = source_files()
    if files is None or any(file.stat().st_mtime > _loaded - _SETTLED_S for file in files):
        return None
    for file, name in files.items():
        digest.update(f"{name}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def source_files() -> dict[Path, Path] | None:
    """The Python files of jaxslam and its kernels, each with its path inside its package; `None` if a package is not
    found as a folder of files.
    """
    found: dict[Path, Path] = {}
    for package in _PACKAGES:
        spec = util.find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            return None
        root = Path(spec.submodule_search_locations[0])
        found |= {file: file.relative_to(root) for file in sorted(root.rglob("*.py"))}
    return found


def _read(file: Path) -> _Kept | None:
    if not file.parent.is_dir() or not _trusted(file.parent):
        return None
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as problem:
        _log.warning("%s: cannot be read: %s", file, problem)
        return None
    with contextlib.suppress(OSError):  # of a disk that is read-only nothing is removed either
        file.touch()
    if hashlib.sha256(data[32:]).digest() != data[:32]:
        _log.warning("%s: damaged; it is written again", file)
        return None
    structure, program = data[32:].split(b"\n", 1)
    try:
        return bytearray(program), _structure_from_json(json.loads(structure))
    except LookupError:
        return None  # a class of the result is not loaded: traced again


def _write(file: Path, kept: _Kept) -> None:
    program, skeleton = kept
    structure = _structure_to_json(skeleton)
    reads_only = (
        jax.config.values["jax_persistent_cache_min_compile_time_secs"] == math.inf
    )  # by `jaxslam.runtime.compile_cache`
    if structure is None or file.parent in _unwritable or reads_only:
        return
    data = json.dumps(structure).encode() + b"\n" + program
    try:
        file.parent.mkdir(mode=OWN_MODE, parents=True, exist_ok=True)
        if _trusted(file.parent):
            _remove_old(file.parent)
            write_atomically(file, hashlib.sha256(data).digest() + data)
    except (OSError, JaxSlamError) as problem:
        _unwritable.add(file.parent)
        _log.warning("%s: traces cannot be kept, so that every start takes longer: %s", file.parent, problem)


_unwritable: set[Path] = set()
"""Folders that a trace could not be written to: said once for each, and not tried again."""


@functools.cache
def _trusted(folder: Path) -> bool:
    """Whether only the user can have written what is in a folder; if not, a warning says why, once a process."""
    why = why_not_own(folder)
    if why is not None:
        _log.warning("%s: not used to keep traces, so that every start takes longer: %s", folder, why)
    return why is None


def _structure_to_json(value: Any) -> Any:
    """The nested containers of a result as JSON; `None` if it holds one of another kind than a tuple, a named tuple,
    a list, a dictionary with text as keys, or a dataclass.
    """
    parts: dict[str, Any]
    if value is None or isinstance(value, bool | int | str):
        return [value]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        parts = value
    elif type(value) in (tuple, list):
        parts = {str(index): part for index, part in enumerate(value)}
    elif isinstance(value, tuple) and (names := getattr(value, "_fields", None)) is not None:
        parts = dict(zip(names, value, strict=True))
    elif dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    else:
        return None
    inner = {name: _structure_to_json(part) for name, part in parts.items()}
    return None if None in inner.values() else [f"{type(value).__module__}:{type(value).__qualname__}", inner]


def _structure_from_json(written: list[Any]) -> Any:
    """Read what `_structure_to_json` wrote. No code of the classes is called.

    Raises:
        LookupError: If a class is not loaded in this process, or is none of those.
    """
    if len(written) == 1:
        return written[0]
    name, inner = written
    parts = {key: _structure_from_json(part) for key, part in inner.items()}
    module, _, qualified = name.partition(":")
    kind: Any = sys.modules[module]
    for attribute in qualified.split("."):
        if attribute not in vars(kind):
            raise LookupError(name)
        kind = vars(kind)[attribute]
    if kind in (dict, list):
        return parts if kind is dict else list(parts.values())
    if issubclass(kind, tuple):
        return tuple.__new__(kind, parts.values())
    if not dataclasses.is_dataclass(kind):
        raise LookupError(name)
    made: Any = object.__new__(cast(type, kind))
    for key, part in parts.items():
        object.__setattr__(made, key, part)
    return made


@functools.cache
def _remove_old(folder: Path) -> None:
    """Once a process."""
    for file in folder.iterdir():
        if file.stat().st_mtime < _loaded - _KEPT_DAYS * 86400:
            file.unlink(missing_ok=True)
