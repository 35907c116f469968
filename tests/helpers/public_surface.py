"""The public surface of jaxslam: every name that the code, scripts, and files of a user depend on.

Run from a checkout with `--write` to store the surface, or without it to compare the surface with the stored one:

    .venv/bin/python tests/helpers/public_surface.py --write
"""

import ast
import contextlib
import csv
import dataclasses
import enum
import inspect
import io
import json
import re
import sys
import tempfile
import textwrap
import types
import zipfile
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints
from unittest import mock

import numpy as np
from small_map import small_map

import jaxslam
from jaxslam.cli import command_table
from jaxslam.cli import main as main_command
from jaxslam.config import Config, presets
from jaxslam.map import save_map
from jaxslam.results import evaluated_run, run_results
from jaxslam.slam import FrameRecord
from jaxslam.slam.dense_thread import DenseMapping
from jaxslam.trajectory import RelativePoses

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = Path(jaxslam.__file__).parent
STORED = ROOT / "tests/host/repository/public_surface.json"
COMMAND = ".venv/bin/python tests/helpers/public_surface.py --write"
ADVICE = (
    "the public surface changed: if on purpose, list it in CHANGELOG.md (table 'Changed names') and run"
    f" `{COMMAND}` to store it"
)

Entries = dict[str, str]
"""The names of one section, each with its description (parameters, value, type, default); it may be empty."""
Surface = dict[str, Entries]
"""The entries of each section."""

_PROTOCOL = ("__call__", "__getitem__", "__len__")
"""Special methods that belong to the surface, because users write them for their own detectors and datasets."""


def public_surface() -> Surface:
    """Compute the surface of the installed code: sorted entries by section, ready for JSON."""
    sections = {
        "Python names": python_names(),
        "codes": codes(),
        "result files": result_files(),
        "commands": commands(),
        "settings": settings(),
        "map file": map_file(),
    }
    return {section: dict(sorted(entries.items())) for section, entries in sections.items()}


def read_surface(path: Path = STORED) -> Surface:
    """Read a surface that `write_surface` stored."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_surface(surface: Surface, path: Path = STORED) -> None:
    """Store a surface as JSON with one entry on each line."""
    path.write_text(json.dumps(surface, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def differences(old: Surface, new: Surface) -> list[str]:
    """List the entries that were removed, added, or changed between two surfaces, one line each, by section."""
    lines = []
    for section in dict.fromkeys((*old, *new)):
        before, after = old.get(section, {}), new.get(section, {})
        changed = sorted(name for name in before.keys() & after.keys() if before[name] != after[name])
        lines += [f"{section}: removed: {_entry(name, before)}" for name in sorted(before.keys() - after.keys())]
        lines += [f"{section}: added: {_entry(name, after)}" for name in sorted(after.keys() - before.keys())]
        lines += [f"{section}: changed: {name}: {before[name]} -> {after[name]}" for name in changed]
    return lines


def _entry(name: str, entries: Entries) -> str:
    return f"{name}: {entries[name]}" if entries[name] else name


# Python names


def python_names() -> Entries:
    """List the names of every package index, and the public fields, attributes, properties, and methods of classes."""
    entries: Entries = {}
    homes: dict[int, str] = {}
    for package, names in _indexes().items():
        for name, value in names.items():
            place = f"{package}.{name}"
            home = homes.setdefault(id(value), place) if callable(value) else place  # equal constants may share an id
            entries[place] = _kind(value) if home == place else f"is {home}"
            if isinstance(value, type) and home == place:
                entries |= {f"{place}.{member}": about for member, about in _members(value).items()}
    return entries


def _indexes() -> dict[str, dict[str, Any]]:
    """Collect the public names and values of every package that has an index, outer packages first."""
    stubs = sorted(PACKAGE.rglob("__init__.pyi"), key=lambda stub: (len(stub.parts), stub))
    packages = {".".join(["jaxslam", *stub.parent.relative_to(PACKAGE).parts]): stub for stub in stubs}
    return {
        package: {name: getattr(import_module(package), name) for name in _names_in(stub)}
        for package, stub in packages.items()
    }


def _names_in(stub: Path) -> Iterator[str]:
    """Yield the names that an index declares for type checkers."""
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            yield from (alias.asname or alias.name for alias in node.names)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id


def _kind(value: object) -> str:
    """Describe a public value: its kind, and the parameters of a class or function."""
    if isinstance(value, enum.EnumType):
        return "enumeration"
    if isinstance(value, type) and issubclass(value, Exception):
        return "exception"
    if isinstance(value, type) and getattr(value, "_is_protocol", False):
        return "protocol"
    if isinstance(value, type):
        return f"class{_parameters(value)}"
    if get_origin(value) is not None:
        return _described(value) if get_origin(value) is Literal else "type"
    return f"function{_parameters(value)}" if callable(value) else "constant"


def _parameters(function: Any, first: int = 0) -> str:
    """Format the names and simple defaults of parameters, without annotations and without the `first` parameters."""
    shown = []
    for parameter in list(inspect.signature(function).parameters.values())[first:]:
        default = parameter.default
        plain = isinstance(default, str | int | float | None) and not isinstance(default, enum.Enum)
        if default is not parameter.empty and not plain:
            default = ...
        shown.append(parameter.replace(annotation=parameter.empty, default=default))
    return str(inspect.Signature(shown)).replace("Ellipsis", "...")


def _members(cls: type) -> Entries:
    """Describe the public members of a class, including those it inherits from classes of jaxslam."""
    members = {name: about for part in reversed(cls.__mro__) for name, about in _members_of(part).items()}
    codes = cls.__members__ if isinstance(cls, enum.EnumType) else ()
    return {name: about for name, about in members.items() if name not in codes}


def _members_of(cls: type) -> Entries:
    """Describe the public members that a class of jaxslam defines itself."""
    if cls.__module__.partition(".")[0] not in ("jaxslam", "jaxslam_kernels"):
        return {}
    fields = {*getattr(cls, "_fields", ()), *getattr(cls, "__dataclass_fields__", ())}
    names = {**dict.fromkeys(inspect.get_annotations(cls)), **dict.fromkeys(_assigned_attributes(cls))}
    members = {name: "field" if name in fields else "attribute" for name in names}
    for name, value in vars(cls).items():
        if isinstance(value, property):
            members[name] = "property"
        elif isinstance(value, classmethod):
            members[name] = f"class method{_parameters(value.__func__, 1)}"
        elif isinstance(value, staticmethod):
            members[name] = f"static method{_parameters(value.__func__)}"
        elif inspect.isfunction(value):
            members[name] = f"method{_parameters(value, 1)}"
        else:
            members.setdefault(name, "attribute")
    return {name: about for name, about in members.items() if not name.startswith("_") or name in _PROTOCOL}


def _assigned_attributes(cls: type) -> Iterator[str]:
    """Yield the attributes that the methods of a class assign to `self`."""
    if hasattr(cls, "_fields"):
        return
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(cls)))):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and isinstance(node.value, ast.Name):
            yield from [node.attr] if node.value.id == "self" else []


# Codes


def codes() -> Entries:
    """List the names and values of every public enumeration and of the exit codes."""
    public = [value for names in _indexes().values() for value in names.values()]
    kinds: list[Any] = [value for value in public if isinstance(value, enum.EnumType)]
    return {f"{kind.__name__}.{one.name}": repr(one.value) for kind in (*kinds, command_table.ExitCode) for one in kind}


# Result files


def result_files() -> Entries:
    """List the files of a run, the columns of its tables, and the fields of its summary.

    They are read from the results of a made-up run, written without compiling the tracker.
    """
    with tempfile.TemporaryDirectory() as folder:
        _write_made_up_run(Path(folder))
        written = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    entries = dict.fromkeys((*written, *run_results.RESULT_FILES), "")
    for name, content in written.items():
        if name.endswith(".json"):
            entries |= {f"{name}: {key}": about for key, about in _keys(json.loads(content))}
        elif name.endswith(".csv"):
            head = next(csv.reader(io.StringIO(content.decode())))
            entries |= {f"{name}: {column}": f"column {place}" for place, column in enumerate(head)}
    return {re.sub(r"(?<=submap_)\d+", "N", name): about for name, about in entries.items()}


def _write_made_up_run(folder: Path) -> None:
    """Write the results of a run on a small map that has ground truth, a dense map, submaps, and every status."""
    map = small_map()
    path = jaxslam.Trajectory(np.arange(1, 4) * 10**9, np.eye(7)[[0, 0, 0]] + np.eye(7)[[4, 5, 6]])
    replaced = {"map": map, "trajectories": {map.world_submap: path, 1: path}}
    assert all(hasattr(jaxslam.Slam, name) for name in replaced)
    config = jaxslam.load_config(overrides=("dynamics.occlusion.enabled=true", "semantics.model=null"))
    slam: Any = type("MadeUpSlam", (jaxslam.Slam,), replaced)(map.camera, config)
    slam.dense_mapping = _Answers(DenseMapping)
    for stage in _stages():
        slam.times.add(stage, 0.01)
    size = map.camera.height, map.camera.width
    frame = jaxslam.Frame(10**9, np.zeros(size, np.uint8), np.zeros(size, np.float32))
    frames: Any = mock.MagicMock(camera=map.camera, ground_truth=path, timestamps_ns=path.timestamps_ns)
    frames.name, frames.__getitem__.return_value = "made up", frame
    with mock.patch.object(evaluated_run, "evaluate", return_value=_evaluation(path)):
        poses = RelativePoses(
            path.timestamps_ns[1:],
            path.timestamps_ns[:-1],
            path.T_world_cam[1:],
            np.eye(6, dtype=np.float32)[None][[0, 0]],
        )
        info = run_results.RunInfo(frames, "default", 1.0)
        run_results.write_results(folder, slam, _records(), info, poses=poses)


def _records() -> list[FrameRecord]:
    """Make one record for each status and each mask source, with a value in every field."""
    hints: dict[str, Any] = get_type_hints(FrameRecord)
    fields = {name: _made_up(hint) for name, hint in hints.items()}
    records: list[dict[str, Any]] = [
        fields | {name: code} for name, hint in hints.items() if isinstance(hint, enum.EnumType) for code in hint
    ]
    return [FrameRecord(**values) for values in records]


def _evaluation(path: jaxslam.Trajectory) -> jaxslam.Evaluation:
    """Make an evaluation in which every figure is known."""
    positions = path.T_world_cam[:, 4:]
    values: dict[str, Any] = {name: _made_up(hint) for name, hint in get_type_hints(jaxslam.Evaluation).items()}
    values |= {"timestamps_ns": path.timestamps_ns, "errors_m": np.zeros(len(positions))}
    values |= {"positions_m": positions, "reference_m": positions}
    return jaxslam.Evaluation(**values)


class _Answers:
    """Stand-in for an object of a class: its properties and methods return made-up values of the annotated types."""

    def __init__(self, cls: type) -> None:
        self._cls = cls

    def __getattr__(self, name: str) -> Any:
        value = inspect.getattr_static(self._cls, name)
        answer = _made_up(get_type_hints(value.fget if isinstance(value, property) else value)["return"])
        return answer if isinstance(value, property) else lambda: answer


def _made_up(hint: Any) -> Any:
    """Make up a value that fits an annotation and is neither zero, nor empty, nor `None`."""
    if isinstance(hint, enum.EnumType):
        return next(iter(hint))
    if hint in (bool, int, float, str):
        return hint(1)
    if hasattr(hint, "dtypes"):  # an array; named dimensions get length 2
        shape = [int(size) if size.isdigit() else 2 for size in hint.dim_str.split()]
        return np.ones(shape, np.dtype(hint.dtypes[-1].rstrip("_")))
    if hasattr(hint, "_fields"):
        return hint(**{name: _made_up(kind) for name, kind in get_type_hints(hint).items()})
    if get_origin(hint) is tuple:
        return (_made_up(get_args(hint)[0]),)
    first = get_args(hint)[0]
    return first if get_origin(hint) is Literal else _made_up(first)


def _stages() -> set[str]:
    """Find the names of all timed stages: texts passed to `ends` and `timed`, and texts paired with a `partial` job.

    Where a function passes a name on to `timed`, the texts that it is called with in the same file count too.
    """
    stages: set[str] = set()
    for file in PACKAGE.rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        passed_on = {
            function.name
            for function in ast.walk(tree)
            if isinstance(function, ast.FunctionDef)
            and any(isinstance(call.args[0], ast.Name) for call in _calls(function, {"timed"}))
        }
        for call in _calls(tree, {"ends", "timed"}):
            stages |= _texts(call.args[:1])
        for call in _calls(tree, passed_on):
            stages |= _texts(call.args)
        for pair in ast.walk(tree):
            if isinstance(pair, ast.Tuple) and len(pair.elts) == 2 and _is_partial(pair.elts[1]):
                stages |= _texts(pair.elts[:1])
    return stages


def _calls(tree: ast.AST, names: set[str]) -> list[ast.Call]:
    """Find the calls of methods with one of the names and at least one argument."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in names and node.args
    ]


def _is_partial(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "partial"


def _texts(arguments: list[ast.expr]) -> set[str]:
    return {one.value for one in arguments if isinstance(one, ast.Constant) and isinstance(one.value, str)}


def _keys(value: object, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted keys of a JSON document. A group of statistics is one key, described by their names."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            name = f"{path}.{key}" if path else key
            if isinstance(inner, Mapping) and "mean" in inner:
                yield name, ", ".join(inner)
            else:
                yield name, ""
                yield from _keys(inner, name)


# Commands and settings


def commands() -> Entries:
    """List every command with its flags and arguments, and their types, choices, and defaults."""
    entries: Entries = dict.fromkeys(re.findall(r"^ +(-.*?)  ", _help(), re.MULTILINE), "")
    for command in command_table.COMMANDS:
        entries[command.name] = ""
        if command.place is None:
            continue
        options = command.options()
        hints = get_type_hints(options, include_extras=True)
        arguments = 0
        for field in dataclasses.fields(options):
            hint, flag = hints[field.name], field.name.replace("_", "-")
            about = _described(hint) + _default_of(field)
            if "Positional" in map(str, getattr(hint, "__metadata__", ())):
                arguments += 1
                entries[f"{command.name} {field.name.upper()}"] = f"argument {arguments}: {about}"
            else:
                name = f"--{flag}, --no-{flag}" if hint is bool else f"--{flag}"
                entries[f"{command.name} {name}"] = about
    return entries


def _help() -> str:
    """Return the text that `jaxslam --help` prints."""
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        main_command(["--help"])
    return text.getvalue()


def settings() -> Entries:
    """List the configuration keys with their types and defaults, and the names of the presets."""
    keys = {f"key {key}": about for key, about in _settings_of(Config)}
    return keys | {f"preset {name}": "" for name in presets()}


def _settings_of(section: type[Any], path: str = "") -> Iterator[tuple[str, str]]:
    hints = get_type_hints(section, include_extras=True)
    for field in dataclasses.fields(section):
        hint, name = hints[field.name], path + field.name
        sections = (kind for kind in (hint, *get_args(hint)) if isinstance(kind, type))
        inner = next((kind for kind in sections if dataclasses.is_dataclass(kind)), None)
        if inner is None or get_args(hint):
            yield name, _described(hint) + _default_of(field)
        if inner is not None:
            yield from _settings_of(inner, f"{name}.")


def _default_of(field: dataclasses.Field[Any]) -> str:
    """Format the default of a field as the end of its description; empty if the field is required."""
    if field.default_factory is not dataclasses.MISSING:
        return f" = {field.default_factory()!r}"
    if field.default is dataclasses.MISSING:
        return ""
    return f" = {field.default.as_posix() if isinstance(field.default, Path) else repr(field.default)}"


def _described(hint: Any) -> str:
    """Describe an annotation, including choices and ranges."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        ranges = [str(part) for part in parts[1:] if type(part).__module__.startswith("jaxslam")]
        return " ".join([_described(parts[0]), *ranges])
    if origin is Literal:
        return " | ".join(map(repr, parts))
    if origin in (Union, types.UnionType):
        return " | ".join(map(_described, parts))
    if origin is tuple:
        return f"tuple[{', '.join('...' if part is ... else _described(part) for part in parts)}]"
    if dataclasses.is_dataclass(hint):
        return "section"
    return "None" if hint is types.NoneType else hint.__name__


# Map file


def map_file() -> Entries:
    """List the members of a map file with their dtypes and ranks, and the fields of its header."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.npz"
        save_map(path, small_map())
        with zipfile.ZipFile(path) as archive:
            texts = {name: archive.read(name) for name in archive.namelist() if not name.endswith(".npy")}
        with np.load(path) as members:
            arrays = {name: members[name] for name in members.files if name not in texts}
    entries = {name: f"{array.dtype}, rank {array.ndim}" for name, array in arrays.items()}
    for name, text in texts.items():
        header = json.loads(text)
        entries[name] = ""
        entries |= {f"{name}: {key}": about for key, about in _keys(header)}
        entries |= {f"{name}: {key}": repr(header[key]) for key in ("format", "version")}
    return entries


def main() -> None:
    """Store the surface if `--write` is given; otherwise print how it differs from the stored one."""
    surface = public_surface()
    if sys.argv[1:] == ["--write"]:
        write_surface(surface)
        print(f"wrote {sum(map(len, surface.values()))} entries to {STORED}")
    elif lines := differences(read_surface(), surface):
        sys.exit("\n".join([*lines, ADVICE]))


if __name__ == "__main__":
    main()
