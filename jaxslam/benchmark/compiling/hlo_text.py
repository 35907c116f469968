"""Instructions of a compiled program by the function of jaxslam that wrote them, read from XLA's optimized HLO text."""

import functools
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

_FREE = frozenset({"parameter", "get-tuple-element", "tuple", "constant", "bitcast"})
"""Operations that name a value and compute nothing."""
_PACKAGES = ("jaxslam", "jaxslam_kernels")
_WRAPPERS = "runtime/"
"""Functions in this folder of a package wrap all others: what is theirs alone comes from no function of the source."""
NO_FUNCTION = "-"
"""Function of the instructions that XLA made by itself, or that have lost their origin."""
_TABLES = ("FileNames", "FunctionNames", "FileLocations", "StackFrames")
_TEXT_ROW = re.compile(r'(\d+) "(.*)"')
_NUMBER = re.compile(r"(\w+)=(\d+)")
_COMPUTATION = re.compile(r"^(?:ENTRY )?%?([\w.\-]+) .*\{\s*$")
_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?([\w.\-]+) = (?:\S+|\(.*?\)) ([\w\-]+)\(")
_FRAME = re.compile(r"stack_frame_id=(\d+)")
_CALLS = re.compile(r"calls=%?([\w.\-]+)")


class Instruction(NamedTuple):
    """One instruction of a program.

    Attributes:
        operation: Name of the operation, such as `add` or `fusion`.
        is_kernel: Whether it stands outside every fused computation.
        function: Innermost function of jaxslam or its kernels that wrote it, `module.function` with the packages of the
            module below `jaxslam`; of a fusion that has lost it, that of most instructions inside; `NO_FUNCTION` if
            there is none.
    """

    operation: str
    is_kernel: bool
    function: str

    @property
    def counts(self) -> bool:
        """True if it computes anything; parameters, constants, tuples and bitcasts do not."""
        return self.operation not in _FREE


class Count(NamedTuple):
    """Size of a program, or of what a function wrote of it.

    Attributes:
        instructions: Number of instructions that compute something, inside fused computations or outside.
        kernels: Number of those outside.
    """

    instructions: int
    kernels: int


def read_instructions(text: str) -> dict[str, Instruction]:
    """Read the instructions of all computations of a program.

    Args:
        text: Optimized HLO, as `jax.stages.Compiled.as_text` gives it.

    Returns:
        The instructions by their names, which are unique in a program.
    """
    function_of = functools.cache(functools.partial(_function, _read_tables(text)))
    fused, computation = set(_CALLS.findall(text)), ""
    found: dict[str, Instruction] = {}
    inside: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for line in text.splitlines():
        if (opened := _COMPUTATION.match(line)) is not None:
            computation = opened[1]
        elif (instruction := _INSTRUCTION.match(line)) is not None:
            frame = _FRAME.search(line)
            function = NO_FUNCTION if frame is None else function_of(int(frame[1]))
            called = _CALLS.search(line)
            if called is not None and function == NO_FUNCTION and inside[called[1]]:
                function = inside[called[1]].most_common(1)[0][0]  # a computation stands before what calls it
            if function != NO_FUNCTION:
                inside[computation][function] += 1
            found[instruction[1]] = Instruction(instruction[2], computation not in fused, function)
    return found


def module_name(text: str) -> str:
    """Return the name of the program in an HLO text."""
    return text.split(maxsplit=2)[1].rstrip(",")


def count(instructions: Iterable[Instruction]) -> Count:
    """Count instructions and kernels."""
    counted = [instruction for instruction in instructions if instruction.counts]
    return Count(len(counted), sum(instruction.is_kernel for instruction in counted))


def count_by_function(instructions: Iterable[Instruction]) -> dict[str, Count]:
    """Count the instructions and kernels that each function wrote, the largest first."""
    counted = [instruction for instruction in instructions if instruction.counts]
    kernels = Counter(instruction.function for instruction in counted if instruction.is_kernel)
    of_all = Counter(instruction.function for instruction in counted)
    return {name: Count(number, kernels[name]) for name, number in of_all.most_common()}


_Tables = Mapping[str, Mapping[int, Any]]


def _read_tables(text: str) -> _Tables:
    """Read the tables before the first computation: files, functions, places in them, and stack frames."""
    tables: dict[str, dict[int, Any]] = {name: {} for name in _TABLES}
    table = ""
    for line in map(str.strip, text.splitlines()):
        if line in tables:
            table = line
        elif line.endswith("{"):
            break
        elif (named := _TEXT_ROW.match(line)) is not None and table:
            tables[table][int(named[1])] = named[2]
        elif table and line[:1].isdigit():
            tables[table][int(line.split(maxsplit=1)[0])] = {key: int(value) for key, value in _NUMBER.findall(line)}
    return tables


def _function(tables: _Tables, frame: int) -> str:
    """Return the innermost function of ours from a stack frame outward."""
    parent = 0
    while frame != parent and frame in tables["StackFrames"]:
        row = tables["StackFrames"][frame]
        place = tables["FileLocations"].get(row.get("file_location_id"), {})
        name = _our_name(tables["FileNames"].get(place.get("file_name_id"), ""))
        if name:
            return f"{name}.{tables['FunctionNames'].get(place.get('function_name_id'), '?')}".replace(".<locals>", "")
        # The outermost frame is its own parent.
        frame, parent = row.get("parent_frame_id", frame), frame
    return NO_FUNCTION


@functools.cache
def _our_name(file: str) -> str:
    """Return the dotted name of a module of ours below its package; empty for any other file."""
    for root in _roots():
        if file.startswith(root) and not file.removeprefix(root).startswith(_WRAPPERS):
            return file.removeprefix(root).removesuffix(".py").replace("/", ".")
    return ""


@functools.cache
def _roots() -> tuple[str, ...]:
    """Return the folders of our packages with a slash behind. A path that merely contains `jaxslam` may be anything."""
    specs = map(find_spec, _PACKAGES)
    return tuple(f"{Path(spec.origin).parent.as_posix()}/" for spec in specs if spec is not None and spec.origin)
