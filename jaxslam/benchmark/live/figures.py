"""Figures of one live run, and how a program that was timed says them."""

import json
import re
from dataclasses import asdict, dataclass, fields
from typing import Any

from jaxslam.errors import BenchmarkError

_WORDS = {"median_ms": "median", "p95_ms": "p95", "max_ms": "max", "cpu_ms": "processor time"}


@dataclass(frozen=True)
class LiveFigures:
    """Figures of one live run.

    Attributes:
        frames: Number of frames that the program was given.
        tracked: Number of frames with a pose.
        median_ms: Median time of a frame on the wall clock, milliseconds.
        p95_ms: 95th percentile of it.
        max_ms: Largest; `None` if the program does not say.
        cpu_ms: Processor time of the whole process for a frame, all that is done beside included, milliseconds.
        late: Number of frames that were due before the one before was done; `None` if the program does not say.
        ate_m: RMSE of the positions after SE(3) alignment, meters; `None` without ground truth.
        peak_mb: Peak resident memory of the process, megabytes; measured from outside, 0 until then.
    """

    frames: int
    tracked: int
    median_ms: float
    p95_ms: float
    cpu_ms: float
    max_ms: float | None = None
    late: int | None = None
    ate_m: float | None = None
    peak_mb: float = 0.0

    def as_json(self) -> str:
        """Return the figures as a line of JSON, which `parse_figures` reads."""
        return json.dumps(asdict(self))


def parse_figures(name: str, printed: str) -> LiveFigures:
    """Read what a program printed: a line of JSON with the fields of `LiveFigures`, or words.

    The words are `160 frames, 158 OK; median 20.0 ms, p95 25.9, max 31; processor time 36.2 ms a frame`, in any order.

    Args:
        name: Name of the program, for errors.
        printed: Its standard output.

    Raises:
        BenchmarkError: If figures are missing.
    """
    lines = [line.strip() for line in printed.splitlines()]
    for line in reversed(lines):
        if line.startswith("{"):
            return _from_json(name, line)
    found: dict[str, Any] = {}
    for field, word in _WORDS.items():
        if numbers := re.findall(rf"\b{word} (\d+(?:\.\d+)?)", printed):
            found[field] = float(numbers[-1])
    for field, word in (("frames", "frames"), ("tracked", "OK")):
        if numbers := re.findall(rf"(\d+) {word}\b", printed):
            found[field] = int(numbers[-1])
    return _checked(name, found)


def _from_json(name: str, line: str) -> LiveFigures:
    try:
        return _checked(name, json.loads(line))
    except json.JSONDecodeError as error:
        raise BenchmarkError(f"{name}: expected a line of JSON, got {line[:80]!r}: {error}") from None


def _checked(name: str, found: dict[str, Any]) -> LiveFigures:
    needed = [field.name for field in fields(LiveFigures) if field.default is not None and field.name != "peak_mb"]
    missing = [field for field in needed if not isinstance(found.get(field), (int, float))]
    if missing:
        raise BenchmarkError(f"{name}: expected {', '.join(needed)} in what it prints, got no {', '.join(missing)}")
    return LiveFigures(**{field.name: found[field.name] for field in fields(LiveFigures) if field.name in found})
