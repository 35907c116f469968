"""The budget of the step: sizes of its two programs, which may grow only if whoever makes them grow says so."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from jaxslam.benchmark.machine_names import compiled_with, cpu_name
from jaxslam.benchmark.suites.baseline import read_baseline
from jaxslam.config.validation import ValidatedConfig
from jaxslam.errors import BenchmarkError, JaxSlamError
from jaxslam.io.atomic_files import write_atomically

BUDGET_PARTS = ("flow", "step")
"""Parts whose main programs have a budget."""
PROGRAMS = ("follow_points", "track_followed")
"""Names of these programs."""
MAX_GROWTH, MAX_SLACK = 0.02, 0.10
"""Share by which a count may exceed its budget, and share by which it may fall below before the budget is lowered."""
UPDATE = "jaxslam bench compile --update-budget"
"""Command that writes the budget anew."""
_NUM_GROWN = 5


@dataclass(frozen=True)
class ProgramBudget(ValidatedConfig):
    """Size of one program.

    Attributes:
        instructions: Number of instructions that compute something.
        kernels: Number of those outside fused computations.
        functions: Number of instructions by function, to name those that have grown.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    instructions: int
    kernels: int
    functions: Mapping[str, int]


@dataclass(frozen=True)
class Budget(ValidatedConfig):
    """Sizes of the programs of a frame.

    Attributes:
        machine: CPU and vector instructions for which they were compiled.
        versions: Versions of the libraries that compiled them.
        programs: Sizes by name of the program.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    machine: str
    versions: str
    programs: Mapping[str, ProgramBudget]


def make_budget(rows: Sequence[Mapping[str, Any]], machine: Mapping[str, Any]) -> Budget:
    """Make a budget of what was measured.

    Args:
        rows: Rows of `measure_part` for the parts of the budget.
        machine: Machine and versions, from `jaxslam.runtime.machine.machine`.
    """
    programs = {
        row["program"]: ProgramBudget(row["instructions"], row["kernels"], _sizes(row))
        for row in rows
        if row["program"] in PROGRAMS
    }
    return Budget(cpu_name(machine), compiled_with(machine), programs)


def load_budget(path: Path) -> Budget:
    """Read a budget.

    Raises:
        BenchmarkError: If the file is missing or is no budget.
    """
    return read_baseline(Budget, path, UPDATE)


def save_budget(path: Path, budget: Budget) -> None:
    """Write a budget.

    Raises:
        BenchmarkError: If the file cannot be written.
    """
    write_atomically(path, (json.dumps(asdict(budget), indent=1) + "\n").encode(), BenchmarkError)


def off_budget(budget: Budget, now: Budget) -> list[str]:
    """Say in one sentence each which counts exceed the budget, or lie so far below that it should be lowered.

    Args:
        budget: The budget.
        now: Sizes of the programs as they are compiled now.
    """
    found = []
    for name, allowed in budget.programs.items():
        if name not in now.programs:
            found.append(f"{name}: expected such a program, got {', '.join(now.programs) or 'none'}")
            continue
        here = now.programs[name]
        for what in ("instructions", "kernels"):
            limit, counted = getattr(allowed, what), getattr(here, what)
            more = counted - limit
            said = f"{name}: {counted:,} {what}, {100 * abs(more) / limit:.1f} %"
            if more > MAX_GROWTH * limit:
                grown = _grown(allowed.functions, here.functions)
                found.append(f"{said} above the budget of {limit:,}; grown most: {grown or 'no function'}")
            elif more < -MAX_SLACK * limit:
                found.append(f"{said} below the budget of {limit:,}: lower the budget, or it guards nothing")
    return found


def advice(budget: Budget, now: Budget) -> str:
    """Say what to do about a program that is off its budget."""
    other = [
        f"{before} then, {here} now"
        for before, here in ((budget.machine, now.machine), (budget.versions, now.versions))
        if before != here
    ]
    why = f" It was made elsewhere: {'; '.join(other)}." if other else ""
    return f"If it must be, say why in the commit and run `{UPDATE}`.{why}"


def _sizes(row: Mapping[str, Any]) -> dict[str, int]:
    """Number of instructions by function, in the order of the names, so that a change of the budget is short."""
    return {of["function"]: of["instructions"] for of in sorted(row["functions"], key=lambda of: of["function"])}


def _grown(before: Mapping[str, int], now: Mapping[str, int]) -> str:
    """Name the functions that grew most in instructions."""
    by = {name: size - before.get(name, 0) for name, size in now.items()}
    most = sorted((name for name in by if by[name] > 0), key=lambda name: -by[name])[:_NUM_GROWN]
    return ", ".join(f"{name} +{by[name]:,}" for name in most)
