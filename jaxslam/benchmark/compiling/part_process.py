"""Measure the programs of one part in a process of its own, so that memory and caches are those of this part alone.

`python -m jaxslam.benchmark.compiling.part_process` reads the job from its input as JSON, and prints the rows as JSON.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax

from jaxslam.benchmark.compiling.hlo_text import (
    NO_FUNCTION,
    Count,
    Instruction,
    count,
    count_by_function,
    module_name,
    read_instructions,
)
from jaxslam.benchmark.compiling.parts import PARTS, Scene
from jaxslam.benchmark.compiling.recorder import CompiledProgram, recorded
from jaxslam.benchmark.compiling.self_times import NUM_TRACED, NUM_WARM, Spent, room_through_lens, trace_tracker
from jaxslam.benchmark.process_ending import how_it_ended, last_words
from jaxslam.config.loading import load_config
from jaxslam.datasets import Dataset, open_dataset
from jaxslam.errors import BenchmarkError, JaxSlamError, nearest
from jaxslam.runtime.threads import prefer_one_thread
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame

_TRACED = ("flow", "step")
"""Parts that can be run and traced by themselves."""
_ERROR = "error: "
_SETTINGS = ("semantics.model=null",)
_CAMERA = "bonn"
"""Camera without a recording: its lens has distortion, as most have, and that is a good part of the instructions."""


@dataclass(frozen=True)
class PartJob:
    """A part to measure.

    Attributes:
        part: Name of the part.
        recording: Folder of a recording whose camera and frames are taken; `None` for a rendered room.
        gradient_size: Width and height of the images that the gradient is taken of, pixels.
        by_function: Whether the part is also run and traced, if it is one of a frame.
    """

    part: str
    recording: str | None = None
    gradient_size: tuple[int, int] = (160, 120)
    by_function: bool = False


def check_parts(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parts of these names, or all parts if there are none.

    Raises:
        BenchmarkError: If there is no such part.
    """
    for name in names:
        if name not in PARTS:
            raise BenchmarkError(f"--only: expected one of {', '.join(PARTS)}, got '{name}'{nearest(name, PARTS)}")
    return tuple(name for name in PARTS if not names or name in names)


def measure_part(job: PartJob, *, plain: bool = False) -> list[dict[str, Any]]:
    """Measure a part in a process of its own.

    Args:
        job: Part to measure.
        plain: Leave out what the environment says of JAX and XLA, as for figures that are to be compared.

    Returns:
        A row for each program, in the order in which they were compiled: `part`, `program`, `instructions`, `kernels`,
        `trace_s`, `lower_s`, `compile_s`, `peak_mb` and `functions`, a list with `function`, `instructions`, `kernels`,
        and `executed` and `self_ms` per frame, which are `None` where nothing was run.

    Raises:
        BenchmarkError: If the process fails.
    """
    command = [sys.executable, "-m", "jaxslam.benchmark.compiling.part_process"]
    done = subprocess.run(
        command,
        input=json.dumps(asdict(job)),
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
        env=_plain_environment() if plain else None,
    )
    if done.returncode:
        last = last_words(done.stderr)
        said = last.removeprefix(_ERROR) if last.startswith(_ERROR) else f"{how_it_ended(done.returncode)}: {last}"
        raise BenchmarkError(f"{job.part}: {said}")
    return json.loads(done.stdout)


def measure_here(job: PartJob) -> list[dict[str, Any]]:
    """Measure a part in this process, which should have compiled nothing before.

    Raises:
        JaxSlamError: If the recording cannot be read, or is too short to be traced.
    """
    prefer_one_thread()
    jax.config.update("jax_enable_compilation_cache", False)
    dataset = None if job.recording is None else open_dataset(job.recording)
    camera = replace(Camera.load(_CAMERA), readout_s=0.0) if dataset is None else dataset.camera
    scene = Scene(camera, load_config(overrides=_SETTINGS), job.gradient_size)
    traced = job.by_function and job.part in _TRACED
    if traced and dataset is not None and len(dataset) <= NUM_WARM:
        raise BenchmarkError(f"--by-function: expected more than {NUM_WARM} frames, got {len(dataset)}")
    compile_programs = PARTS[job.part](scene)
    with recorded() as programs:
        compile_programs()
    read = {module_name(program.text): read_instructions(program.text) for program in programs}
    spent: Mapping[str, Mapping[str, Spent]] = {}
    if traced:
        spent = trace_tracker(scene, _frames(camera, dataset), read)
    return [_row(job.part, program, spent) for program in programs]


def _plain_environment() -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS" and not name.startswith("JAX_")}
    return kept | {"NPROC": "1", "JAX_PLATFORMS": "cpu"}


def _frames(camera: Camera, dataset: Dataset | None) -> list[Frame]:
    """Read the first frames of a recording, or render those of a room."""
    count = NUM_WARM + NUM_TRACED
    if dataset is None:
        return room_through_lens(camera, count)
    return [dataset[index] for index in range(min(len(dataset), count))]


def _row(part: str, program: CompiledProgram, spent: Mapping[str, Mapping[str, Spent]]) -> dict[str, Any]:
    instructions = read_instructions(program.text)
    figures = {key: value for key, value in vars(program).items() if key not in ("name", "text")}
    functions = _functions(instructions, spent.get(module_name(program.text)))
    return {
        "part": part,
        "program": program.name,
        **count(instructions.values())._asdict(),
        **figures,
        "functions": functions,
    }


def _functions(instructions: Mapping[str, Instruction], spent: Mapping[str, Spent] | None) -> list[dict[str, Any]]:
    """List the functions of a program: what they wrote and, if it was run, what they cost; the dearest first."""
    counts = count_by_function(instructions.values())
    found = []
    for name in [*counts, *(name for name in spent or {} if name not in counts)]:
        cost = None if spent is None else spent.get(name, Spent(0, 0))
        measured = {"executed": None, "self_ms": None} if cost is None else vars(cost)
        found.append({"function": name, **counts.get(name, Count(0, 0))._asdict(), **measured})
    return sorted(found, key=lambda row: (-(row["self_ms"] or 0), -row["instructions"], row["function"] == NO_FUNCTION))


if __name__ == "__main__":
    try:
        print(json.dumps(measure_here(PartJob(**json.load(sys.stdin)))))
    except JaxSlamError as problem:
        print(f"{_ERROR}{problem}", file=sys.stderr)
        sys.exit(1)
