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
  - recording: kitti_00
    sensor: stereo                   # or rgbd: what the recording must be; whichever it is if not given
    runs: 20                         # how often this one, if not as often as the others
ablation: false                      # true shows published figures of parts of systems too
variants:                            # every preset with each of these settings too
  few-points: [track.num_points=256]

Settings of the command line beat those of a suite and its variants.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from jaxslam.config.loading import configs_dir, load_config, presets, updated
from jaxslam.config.schema import Config
from jaxslam.config.validation import Range, ValidatedConfig
from jaxslam.datasets.catalog import name_of
from jaxslam.datasets.synthetic import SyntheticConfig
from jaxslam.errors import BenchmarkError, JaxSlamError, nearest
from jaxslam.io.yaml_files import read_mapping
from jaxslam.semantics.from_config import SCENE

_Positive = Range(at_least=1)


@dataclass(frozen=True)
class Sequence(ValidatedConfig):
    """A recording or a part of one, or a rendered room.

    Attributes:
        name: What it is called in tables and folders.
        recording: The name of its folder; empty for a room.
        room: What is rendered; `None` for a recording.
        start: First frame.
        stop: The frame after the last; `None` for all.
        every: All frames, or every nth, as if the camera were slower.
        camera: Known camera of the recording, or a camera file, seen from the suite's; `None` if its folder tells.
        sensor: What it must have been taken with; `None` for whichever it was.
        runs: How often it is run; `None` for as often as the suite says.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    name: str
    recording: str = ""
    room: SyntheticConfig | None = None
    start: Annotated[int, Range(at_least=0)] = 0
    stop: Annotated[int, _Positive] | None = None
    every: Annotated[int, _Positive] = 1
    camera: str | None = None
    sensor: Literal["rgbd", "stereo"] | None = None
    runs: Annotated[int, _Positive] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.recording) == (self.room is not None):
            raise BenchmarkError(f"sequence {self.name}: expected either `recording` or `room`, got both or neither")
        if self.room is not None and self.sensor not in (None, "stereo" if self.room.baseline_m else "rgbd"):
            raise BenchmarkError(
                f"sequence {self.name}: expected a `room` with baseline_m for stereo, and without for rgbd, got"
                f" baseline_m {self.room.baseline_m} for {self.sensor}"
            )
        if not self.name or "/" in self.name or self.name.startswith("."):
            raise BenchmarkError(f"sequence: expected a name that can be a folder's, got '{self.name}'")

    @property
    def whole(self) -> bool:
        """Whether all of it is run, as published figures are of."""
        return self.start == 0 and self.stop is None and self.every == 1


@dataclass(frozen=True)
class Suite:
    """What is run.

    Attributes:
        name: Of its file.
        about: One line.
        sequences: What is tracked.
        presets: With what.
        runs: How often each sequence that does not say it itself, with the seeds 0, 1, 2, ...
        settings: `key=value` of all runs.
        variants: More settings by name; every preset is run with each, and not without.
        ablation: Whether published figures of parts of systems are shown too.
    """

    name: str
    about: str
    sequences: tuple[Sequence, ...]
    presets: tuple[str, ...] = ("default",)
    runs: int = 1
    settings: tuple[str, ...] = ()
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    ablation: bool = False


def suites() -> dict[str, Path]:
    """The suites that come with jaxslam: files by name."""
    return {path.stem: path for path in sorted((configs_dir() / "benchmarks").glob("*.yaml"))}


def load_suite(name_or_path: str) -> Suite:
    """A suite that comes with jaxslam, one in a file, or all recordings in a folder.

    Args:
        name_or_path: A name in `suites()`, a YAML file, or a folder of recordings, which are run with `static`, `ngd`
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
    content = read_mapping(path, BenchmarkError)
    try:
        return _suite(path.stem, content, path.parent)
    except JaxSlamError as error:
        raise BenchmarkError(f"{path}: {error}") from None


def checked_presets(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names, each once, if all of them are presets.

    Raises:
        BenchmarkError: If one is not, or there is none.
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


def _suite(name: str, content: Mapping[str, Any], folder: Path) -> Suite:
    known = ("about", "presets", "runs", "set", "sequences", "variants", "ablation")
    for key in content:
        if key not in known:
            raise BenchmarkError(f"{key}: unknown key{nearest(key, known)}")
    runs = content.get("runs", 1)
    if isinstance(runs, bool) or not isinstance(runs, int) or runs < 1:
        raise BenchmarkError(f"runs: expected an integer >= 1, got {runs!r}")
    sequences = content.get("sequences")
    if not isinstance(sequences, list) or not sequences:
        raise BenchmarkError("sequences: expected a list of at least one")
    made = tuple(_sequence(f"sequences[{index}]", entry, folder) for index, entry in enumerate(sequences))
    names = [sequence.name for sequence in made]
    for name_of_one in names:
        if names.count(name_of_one) > 1:
            raise BenchmarkError(f"sequences: '{name_of_one}' stands twice; give one of them another `name`")
    variants = content.get("variants", {})
    if not isinstance(variants, Mapping):
        raise BenchmarkError(f"variants: expected names with lists of settings, got {variants!r}")
    ablation = content.get("ablation", False)
    if not isinstance(ablation, bool):
        raise BenchmarkError(f"ablation: expected true or false, got {ablation!r}")
    suite = Suite(
        name,
        str(content.get("about", "")),
        made,
        checked_presets(_texts("presets", content.get("presets", ["default"]))),
        runs,
        _texts("set", content.get("set", [])),
        {str(key): _texts(f"variants.{key}", value) for key, value in variants.items()},
        ablation,
    )
    for variant in suite.variants.values() or [()]:
        for preset in suite.presets:
            check_masks(made, load_config(preset, overrides=(*suite.settings, *variant)))  # now, not after hours
    return suite


def check_masks(sequences: Iterable[Sequence], config: Config) -> None:
    """See whether true masks are asked for where there are any: nobody knows the truth of a recording.

    Raises:
        BenchmarkError: If they are asked for of a recording.
    """
    recordings = [sequence.name for sequence in sequences if sequence.room is None]
    if config.semantics.model == SCENE and recordings:
        raise BenchmarkError(f"semantics.model: '{SCENE}' expected rendered rooms, got the recording {recordings[0]}")


def _sequence(place: str, entry: object, folder: Path) -> Sequence:
    known = ("name", "recording", "room", "start", "stop", "every", "camera", "sensor", "runs")
    if not isinstance(entry, Mapping):
        raise BenchmarkError(f"{place}: expected `recording: NAME` or `room: ...`, got {entry!r}")
    fields = dict(entry)
    for key in fields:
        if key not in known:
            raise BenchmarkError(f"{place}.{key}: unknown key{nearest(str(key), known)}")
    if "room" in fields:
        if not isinstance(fields["room"], Mapping):
            raise BenchmarkError(f"{place}.room: expected settings of the rendered room, got {fields['room']!r}")
        fields["room"] = updated(SyntheticConfig(), fields["room"], f"{place}.room")
    if "name" not in fields and "recording" not in fields:
        raise BenchmarkError(f"{place}: expected a name, got none")
    fields.setdefault("name", fields.get("recording"))
    if isinstance(camera := fields.get("camera"), str) and (folder / camera).is_file():
        fields["camera"] = str((folder / camera).absolute())  # not where the run happens to be
    return Sequence(**fields)


def _texts(place: str, value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise BenchmarkError(f"{place}: expected a list of texts, got {value!r}")
    return tuple(value)
