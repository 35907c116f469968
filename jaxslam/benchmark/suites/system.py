"""Other SLAM systems of a suite: programs that track its recordings, and trajectories that they have left."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from jaxslam.benchmark.external_program import Program, command_words, named_value
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.errors import BenchmarkError, JaxSlamError
from jaxslam.io.yaml_files import checked_mapping

PLACEHOLDERS = ("recording", "calibration", "out", "start", "stop", "every", "rate", "seed")
"""Names that a command may hold in braces; `System.command` says what each stands for."""
_ESSENTIAL = ("recording", "out")
_PART = ("start", "stop", "every")
_HOUR_S = 3600.0


@dataclass(frozen=True)
class System(ValidatedConfig):
    """Another SLAM system, whose trajectories are judged as those of presets are.

    Attributes:
        name: Name in tables, where presets have theirs.
        command: Command line that tracks a recording; empty for a system whose trajectories are there. It is not run by
            a shell. In braces it holds `recording` (folder of the recording), `calibration` (camera file of jaxslam,
            YAML), `out` (file that the trajectory is expected in), `start`, `stop` and `every` (part of the recording,
            as in `Sequence`), `rate` (frames a second) and `seed` (number of the run).
        trajectories: Folder of its trajectories; empty for a command.
        limit_s: Time after which the command is killed with all that it has started, seconds.
        prints_figures: Whether the command prints figures of its frames, as the programs of `jaxslam bench live` do
            (`live.figures.parse_figures`); they are its times of frames in the tables.
        folder: Working directory of the command; empty for that of this process.

    Raises:
        BenchmarkError: If the name is empty or holds an `@`, which begins a variant, if there is not one of `command`
            and `trajectories`, or if the command is malformed.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    name: str
    command: str = ""
    trajectories: str = ""
    limit_s: Annotated[float, Range(above=0)] = _HOUR_S
    prints_figures: bool = False
    folder: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.name.strip() or "@" in self.name:
            raise BenchmarkError(f"systems: expected a name without '@', got '{self.name}'")
        if bool(self.command) == bool(self.trajectories):
            expected = "either `command` or `trajectories`"
            raise BenchmarkError(f"{self.name}: expected {expected}, got {'both' if self.command else 'none'}")
        if self.command:
            self.program(dict.fromkeys(PLACEHOLDERS, ""))
            if lacking := [name for name in _ESSENTIAL if not self._asks_for((name,))]:
                names = " and ".join(f"{{{name}}}" for name in lacking)
                raise BenchmarkError(f"{self.name}: command: expected {names} in it, got '{self.command}'")

    @property
    def chooses_part(self) -> bool:
        """True if the command is told which part of a recording to track."""
        return self._asks_for(_PART)

    def program(self, values: Mapping[str, str]) -> Program:
        """Return the program with values for `PLACEHOLDERS`.

        Raises:
            BenchmarkError: If the command is malformed.
        """
        return Program(self.name, command_words(self.command, values, f"{self.name}: command"))

    def _asks_for(self, names: Iterable[str]) -> bool:
        return any(f"{{{name}}}" in self.command for name in names)


@dataclass(frozen=True)
class _SystemEntry(ValidatedConfig):
    """A system as a suite's file holds it, below its name."""

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    command: str = ""
    trajectories: str = ""
    limit_s: Annotated[float, Range(above=0)] = _HOUR_S
    prints_figures: bool = False


def systems_of_file(entries: Mapping[str, Any], file: Path) -> tuple[System, ...]:
    """Read the systems in a suite's file; paths in it are relative to its folder.

    Args:
        entries: Content of its key `systems`: mappings by name.
        file: File of the suite.

    Raises:
        BenchmarkError: If an entry is malformed, or a folder of trajectories does not exist.
    """
    return tuple(_of_entry(name, entry, file) for name, entry in entries.items())


def parse_system(text: str) -> System:
    """Read `NAME=DIR`, a system whose trajectories lie in a folder.

    Args:
        text: Value of the option `--with`.

    Raises:
        BenchmarkError: If it has another form, or there is no such folder.
    """
    name, folder = named_value("--with", text, "DIR")
    return _with_trajectories(name, Path(folder), "--with")


def _of_entry(name: str, content: object, file: Path) -> System:
    place = f"{file}: systems: {name}"
    entry = from_mapping(_SystemEntry, checked_mapping(content, place, BenchmarkError), place)
    beside = file.parent.absolute()  # not where the run happens to be
    if entry.trajectories and not entry.command:
        return _with_trajectories(name, beside / entry.trajectories, place)
    return System(name, entry.command, entry.trajectories, entry.limit_s, entry.prints_figures, str(beside))


def _with_trajectories(name: str, folder: Path, place: str) -> System:
    if not folder.is_dir():
        hint = "; a suite names commands, under `systems`" if place == "--with" else ""
        raise BenchmarkError(f"{place}: expected a folder of trajectories, got '{folder}'{hint}")
    return System(name, trajectories=str(folder.absolute()))
