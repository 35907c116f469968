"""Suites: which sequences are run with which presets, how often. They are YAML files in `configs/benchmarks`.

about: One line for the list of suites.
presets: [static, ngd, default]
runs: 5
set: [semantics.model=null]          # settings of all runs
sequences:
  - recording: rgbd_bonn_crowd       # a folder of that name
    stop: 220                        # frames from `start` to before `stop`
    camera: my_camera.yaml           # if the recording's folder does not tell; beside the suite's file, or a known one
  - name: room                       # what it is called in tables; a recording's own name if not given
    room: {frames: 90, people: 2}    # rendered, see `SyntheticConfig`; `baseline_m: 0.1` makes stereo pairs of it
  - world: flat                      # rendered, one of `jaxslam world list` or a YAML file beside the suite's
    start: 300
    stop: 500
  - recording: kitti_00
    sensor: stereo                   # or rgbd: what the recording must be; whichever it is if not given
    runs: 20                         # how often this one, if not as often as the others
systems:                             # other systems, judged as presets are
  other-slam:
    command: my_slam {recording} {calibration} {out}    # see `System`; run where the suite's file is, without a shell
    limit_s: 600                     # then it is killed
  third-slam:
    trajectories: results/third      # a folder with crowd.txt, ..., see `trajectories_of`
protocol: rts                        # table of a paper, see `Protocol`: it gives runs, variants and columns
ablation: false                      # true shows published figures of parts of systems too
variants:                            # every preset with each of these settings too
  few-points: [track.num_points=256]

Settings of the command line beat those of a suite and its variants.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from jaxslam.benchmark.suites.protocol import Protocol, load_protocol
from jaxslam.benchmark.suites.system import System, systems_of_file
from jaxslam.config.loading import configs_dir, load_config, presets
from jaxslam.config.schema import Config
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.datasets.catalog import name_of
from jaxslam.datasets.synthetic import SyntheticConfig
from jaxslam.errors import BenchmarkError, JaxSlamError, nearest
from jaxslam.io.yaml_files import checked_mapping, read_mapping
from jaxslam.semantics.from_config import SCENE

_Positive = Range(at_least=1)


@dataclass(frozen=True)
class Sequence(ValidatedConfig):
    """A recording, a rendered room or a world, or a part of one.

    Attributes:
        name: Name in tables and of folders.
        recording: Name of the recording's folder; empty for one that is rendered.
        room: Settings of the rendered room; `None` for others.
        world: Name of the rendered world, or its file; empty for others.
        start: First frame.
        stop: Frame after the last one; `None` for the end of the recording.
        every: Step between frames, as if the camera were slower; 1 for all frames.
        camera: Known camera, or a camera file relative to the suite's; `None` for the camera of the recording.
        sensor: Required sensor of the recording; `None` for any.
        runs: Number of runs; `None` for that of the suite.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    name: str
    recording: str = ""
    room: SyntheticConfig | None = None
    world: str = ""
    start: Annotated[int, Range(at_least=0)] = 0
    stop: Annotated[int, _Positive] | None = None
    every: Annotated[int, _Positive] = 1
    camera: str | None = None
    sensor: Literal["rgbd", "stereo"] | None = None
    runs: Annotated[int, _Positive] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [bool(self.recording), self.room is not None, bool(self.world)]
        if sum(given) != 1:
            expected = "one of `recording`, `room` and `world`"
            raise BenchmarkError(f"sequence {self.name}: expected {expected}, got {sum(given) or 'none'}")
        if self.room is not None and self.sensor not in (None, "stereo" if self.room.baseline_m else "rgbd"):
            raise BenchmarkError(
                f"sequence {self.name}: expected a `room` with baseline_m for stereo, and without for rgbd, got"
                f" baseline_m {self.room.baseline_m} for {self.sensor}"
            )
        if not self.name or "/" in self.name or self.name.startswith("."):
            raise BenchmarkError(f"sequence: expected a name that can be a folder's, got '{self.name}'")

    @property
    def source(self) -> str:
        """Name of the recording or world that it is a part of; empty for a room."""
        return self.recording or self.world

    @property
    def whole(self) -> bool:
        """Whether the whole recording is run, as for published figures."""
        return self.start == 0 and self.stop is None and self.every == 1


@dataclass(frozen=True)
class Suite(ValidatedConfig):
    """Sequences, and the settings that each of them is run with.

    Attributes:
        name: Name of the suite's file.
        about: Description in one line.
        sequences: Sequences to track.
        presets: Presets; every sequence is run with each.
        runs: Number of runs of a sequence that does not give its own number, with the seeds 0, 1, 2, ...
        settings: Settings `key=value` of all runs.
        variants: Further settings by name. Every preset is run with each variant, and not without one.
        ablation: Whether reports also show published figures of parts of systems.
        systems: Other systems that are judged beside the presets.
        protocol: Table of a paper that reports show too; `None` for none.

    Raises:
        BenchmarkError: If a field has the wrong type, or two sequences or systems have the same name.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    name: str
    about: str
    sequences: tuple[Sequence, ...]
    presets: tuple[str, ...] = ("default",)
    runs: Annotated[int, _Positive] = 1
    settings: tuple[str, ...] = ()
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    ablation: bool = False
    systems: tuple[System, ...] = ()
    protocol: Protocol | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, count in Counter(sequence.name for sequence in self.sequences).items():
            if count > 1:
                raise BenchmarkError(f"sequences: '{name}' is listed twice; give one of them another `name`")
        for name, count in Counter(system.name for system in self.systems).items():
            if count > 1 or name in presets():
                used = "is listed twice" if count > 1 else "is a preset"
                raise BenchmarkError(f"systems: '{name}' {used}; expected another name")


@dataclass(frozen=True)
class _SuiteFile(ValidatedConfig):
    """A suite as its file holds it, with the keys that the module describes."""

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    sequences: tuple[Any, ...]
    about: str = ""
    presets: tuple[str, ...] = ("default",)
    runs: Annotated[int, _Positive] | None = None
    set: tuple[str, ...] = ()
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    ablation: bool = False
    systems: Mapping[str, Any] = field(default_factory=dict)
    protocol: Any = None


def suites() -> dict[str, Path]:
    """Find the suites that come with jaxslam: files by name."""
    return {path.stem: path for path in sorted((configs_dir() / "benchmarks").glob("*.yaml"))}


def load_suite(name_or_path: str) -> Suite:
    """Load a suite that comes with jaxslam, a suite in a file, or all recordings in a folder.

    Args:
        name_or_path: Name in `suites()`, a YAML file, or a folder of recordings, which are run with `static`, `ngd`
            and `default`.

    Raises:
        BenchmarkError: If there is no such suite, or the file is wrong; the message names the place.
    """
    path = Path(name_or_path)
    if name_or_path in suites():
        path = suites()[name_or_path]
    elif path.is_dir():
        return _suite_of_folder(path)
    elif not path.is_file():
        hint = nearest(name_or_path, suites())
        raise BenchmarkError(f"suite: expected a known one, a YAML file or a folder, got '{name_or_path}'{hint}")
    file = from_mapping(_SuiteFile, read_mapping(path, BenchmarkError), str(path))
    sequences = [_sequence(entry, f"{path}: sequences[{index}]", path) for index, entry in enumerate(file.sequences)]
    systems = systems_of_file(file.systems, path)
    protocol = None if file.protocol is None else load_protocol(file.protocol, f"{path}: protocol")
    try:
        return _suite(_by_protocol(file, protocol), path.stem, tuple(sequences), systems, protocol)
    except JaxSlamError as error:
        raise BenchmarkError(f"{path}: {error}") from None


def checked_presets(names: tuple[str, ...]) -> tuple[str, ...]:
    """Check that all names are presets, and return each once.

    Raises:
        BenchmarkError: If a name is not a preset, or there are no names.
    """
    if not names:
        raise BenchmarkError("presets: expected at least one")
    for name in names:
        if name not in presets():
            raise BenchmarkError(f"presets: unknown preset '{name}'{nearest(name, presets())}")
    return tuple(dict.fromkeys(names))


def _suite_of_folder(folder: Path) -> Suite:
    lists = [*folder.glob("**/rgb.txt"), *folder.glob("**/sequences/*/times.txt")]
    names = [name_of(path.resolve().parent) for path in sorted(lists)]
    if not names:
        raise BenchmarkError(
            f"{folder}: expected a folder with recordings in it (rgb.txt, or sequences/NN/times.txt), got none"
        )
    return Suite(
        folder.resolve().name,
        f"all recordings in {folder}",
        tuple(Sequence(name, name) for name in names),
        ("static", "ngd", "default"),
    )


def _by_protocol(file: _SuiteFile, protocol: Protocol | None) -> _SuiteFile:
    """Return the file with the runs and variants of its protocol, where it gives none itself.

    Raises:
        BenchmarkError: If both have variants.
    """
    if protocol is None:
        return file
    if file.variants and protocol.variants:
        raise BenchmarkError(f"variants: expected none beside those of the protocol ({', '.join(protocol.variants)})")
    return replace(file, runs=file.runs or protocol.runs, variants=file.variants or protocol.variants)


def _suite(
    file: _SuiteFile,
    name: str,
    sequences: tuple[Sequence, ...],
    systems: tuple[System, ...],
    protocol: Protocol | None,
) -> Suite:
    if not sequences:
        raise BenchmarkError("sequences: expected a list of at least one")
    chosen = checked_presets(file.presets) if file.presets or not systems else ()
    suite = Suite(
        name,
        file.about,
        sequences,
        chosen,
        file.runs or 1,
        file.set,
        file.variants,
        file.ablation,
        systems,
        protocol,
    )
    for variant in suite.variants.values() or [()]:
        for preset in suite.presets:
            check_masks(sequences, load_config(preset, overrides=(*suite.settings, *variant)))  # now, not after hours
    return suite


def check_masks(sequences: Iterable[Sequence], config: Config) -> None:
    """Refuse true masks for recordings, whose true masks are unknown.

    Raises:
        BenchmarkError: If the settings ask for true masks of a recording.
    """
    recordings = [sequence.name for sequence in sequences if sequence.recording]
    if config.semantics.model == SCENE and recordings:
        raise BenchmarkError(
            f"semantics.model: '{SCENE}' expected rendered rooms or worlds, got the recording {recordings[0]}"
        )


def _sequence(entry: object, place: str, file: Path) -> Sequence:
    fields = checked_mapping(entry, place, BenchmarkError)
    if "recording" in fields:
        fields.setdefault("name", fields["recording"])
    if isinstance(world := fields.get("world"), str):
        fields.setdefault("name", Path(world).stem)
        if (file.parent / world).is_file():
            fields["world"] = str((file.parent / world).absolute())
    if isinstance(camera := fields.get("camera"), str) and (file.parent / camera).is_file():
        fields["camera"] = str((file.parent / camera).absolute())  # not where the run happens to be
    return from_mapping(Sequence, fields, place)
