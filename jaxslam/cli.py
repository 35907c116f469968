"""The command line: `jaxslam demo`, `run`, `compare`, `bench`, `eval`, `doctor`, `export`, `models`, `data`."""

import logging
import sys
from collections.abc import Sequence
from typing import Any

import tyro

from jaxslam.commands.bench import Bench
from jaxslam.commands.bench_accuracy import AccuracyRuler
from jaxslam.commands.bench_batch import Batch
from jaxslam.commands.bench_gate import Gate
from jaxslam.commands.bench_kernels import Kernels
from jaxslam.commands.compare import Compare
from jaxslam.commands.data import Data
from jaxslam.commands.doctor import Doctor
from jaxslam.commands.eval import Eval
from jaxslam.commands.export import Export
from jaxslam.commands.models import Models
from jaxslam.commands.run import Demo, Run
from jaxslam.errors import JaxSlamError, MissingModelError

_DESCRIPTION = "Real-time visual SLAM for dynamic scenes. Start with: jaxslam demo"
_OF_BENCH: dict[str, type[Any]] = {"accuracy": AccuracyRuler, "batch": Batch, "gate": Gate, "kernels": Kernels}
"""What `jaxslam bench` does that is no suite, with options of its own."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The `jaxslam` command: known errors are one line and exit code 1, that of a network to get first is 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    command = _parsed(list(sys.argv[1:] if arguments is None else arguments))
    try:
        command.main()
    except JaxSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, MissingModelError) else 1)
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)


def _parsed(words: list[str]) -> Any:
    """The command that these words call for."""
    if words[:1] == ["bench"] and words[1:2] and words[1] in _OF_BENCH:
        return tyro.cli(_OF_BENCH[words[1]], prog=f"jaxslam bench {words[1]}", args=words[2:])
    return tyro.cli(
        Demo | Run | Compare | Bench | Eval | Doctor | Export | Models | Data,
        prog="jaxslam",
        args=words,
        description=_DESCRIPTION,
    )
