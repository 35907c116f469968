"""The runs that a suite and a command line come to, and what the command line changes about the suite."""

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxslam.benchmark.suites.job import Job
from jaxslam.benchmark.suites.run_names import flattened
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.suite import Suite
from jaxslam.benchmark.suites.trajectory_folders import lacking_trajectories, trajectories_of
from jaxslam.datasets.catalog import known_recordings
from jaxslam.errors import BenchmarkError
from jaxslam.worlds.library import load_world
from jaxslam.worlds.stored_world import description_hash, why_not_here

_OPENING, _CLOSING, _QUOTES = "([{", ")]}", "'\""


def plan(
    suite: Suite, *, presets: Sequence[str] = (), runs: int | None = None, settings: Sequence[str] = ()
) -> list[Job]:
    """All runs of a suite; of a system whose trajectories are there, as many as it has.

    Args:
        suite: Suite to run.
        presets: Instead of its own, if there are any.
        runs: Number of runs of each, instead of the number that the suite and its sequences give.
        settings: `key=value` each, applied last: they beat those of the suite and of its variants.
    """
    chosen = dict.fromkeys(presets or suite.presets)
    variants = suite.variants or {"": ()}
    jobs = []
    for clip in suite.sequences:
        once = replace(clip, runs=None)  # a run is the same run, however many others there are
        numbers = range(runs or clip.runs or suite.runs)
        jobs += [
            Job(once, preset, variant, (*suite.settings, *of_variant, *settings), seed)
            for preset in chosen
            for variant, of_variant in variants.items()
            for seed in numbers
        ]
        jobs += [
            Job(once, system.name, "", (), number, system)
            for system in suite.systems
            for number in (numbers if system.command else range(len(trajectories_of(Path(system.trajectories), clip))))
        ]
    return jobs


def missing(suite: Suite, found: Collection[str]) -> dict[str, str]:
    """Recordings that are not there, and worlds that need some, by name, and how to get them.

    Args:
        suite: Suite to run.
        found: Names of the recordings that are there.
    """
    names = [clip.recording for clip in suite.sequences if clip.recording and clip.recording not in found]
    public = known_recordings()
    way = lambda name: f"; to get it: jaxslam data get {name}" if name in public else ", nor in `jaxslam data list`"
    absent = {name: f"not there{way(name)}" for name in names}
    worlds = dict.fromkeys(clip.world for clip in suite.sequences if clip.world)
    return absent | {world: why for world in worlds if (why := why_not_here(load_world(world))) is not None}


def not_judged(suite: Suite, absent: Collection[str]) -> dict[str, str]:
    """Rows of other systems that have no trajectory of a sequence, and why.

    Args:
        suite: Suite to run.
        absent: Recordings and worlds that are not there, whose sequences are left out.

    Raises:
        BenchmarkError: If a system has no trajectory of any sequence, or several for a run.
    """
    present = [clip for clip in suite.sequences if clip.source not in absent]
    rows: dict[str, str] = {}
    for system in suite.systems:
        if system.trajectories:
            rows |= lacking_trajectories(system.name, Path(system.trajectories), present)
    return rows


def swept(suite: Suite, sweeps: Iterable[str]) -> Suite:
    """The suite with every combination of values as a variant.

    Args:
        suite: Suite to run.
        sweeps: `key=v1,v2,...` each. Commas inside brackets or quotes belong to a value: `dynamics.cues=[],[a,b]` has
            two values.

    Raises:
        BenchmarkError: If one is no such text, or two have the same key.
    """
    variants = dict(suite.variants) or {"": ()}
    keys: set[str] = set()
    for sweep in sweeps:
        key, found, text = sweep.partition("=")
        values = _values(text)
        if not found or not key or not all(values):
            raise BenchmarkError(f"--sweep: expected key=value,value,..., got '{sweep}'")
        if key in keys:
            raise BenchmarkError(f"--sweep: expected all values of {key} in one, got '{sweep}' besides another")
        keys.add(key)
        short = key.rpartition(".")[2]
        variants = {
            ",".join(filter(None, (name, f"{short}={value}"))): (*settings, f"{key}={value}")
            for name, settings in variants.items()
            for value in values
        }
    return replace(suite, variants=variants)


def replaced_settings(suite: Suite, settings: Sequence[str], sweeps: Sequence[str] = ()) -> list[str]:
    """List what the command line changes about a suite's own settings, a line each.

    Args:
        suite: Suite as in its file, without sweeps.
        settings: `key=value` each, of `--set`.
        sweeps: `key=v1,v2,...` each, of `--sweep`.

    Raises:
        BenchmarkError: If a setting is given and swept too.
    """
    for setting in settings:
        key = setting.partition("=")[0]
        clash = next((sweep for sweep in sweeps if _same_place(sweep.partition("=")[0], key)), None)
        if clash is not None:
            raise BenchmarkError(f"--sweep: expected no setting that --set gives, got '{clash}' and '{setting}'")
    own = [("the suite", suite.settings), *((f"variant {name}", of_it) for name, of_it in suite.variants.items())]
    given = {setting.partition("=")[0]: setting for setting in (*settings, *sweeps)}
    return [
        f"{setting} from the command line replaces {old if old_key == key else f'{old_key}={old}'} of {whose}"
        for key, setting in given.items()
        for whose, of_it in own
        for old_key, _, old in (text.partition("=") for text in of_it)
        if _same_place(old_key, key) and (old_key, old) != (key, setting.partition("=")[2])
    ]


def fingerprint(jobs: Sequence[Job]) -> dict[str, Any]:
    """Describe what was planned, as plain data that a file can keep and `plan_differences` compares.

    Settings are those that a suite and a command line give, not those of presets: a preset that is changed is what a
    comparison is for. Of rooms and recordings it says what is not as `SyntheticConfig` and `Sequence` have it.

    Args:
        jobs: From `plan`, or those of some presets or sequences of it.

    Returns:
        `sequences` by name, `presets` by label with their settings, and `runs` of each; a sequence with more runs than
        the others says how many.
    """
    labels = {job.label: {"preset": job.preset, "settings": list(job.settings)} for job in jobs}
    rows = Counter((job.clip.name, job.label) for job in jobs)
    least = min(rows.values(), default=0)
    clips = {}
    for job in jobs:
        number = rows[job.clip.name, job.label]
        clips[job.clip.name] = _plain_clip(job.clip) | ({"runs": number} if number > least else {})
    return {"sequences": clips, "presets": labels, "runs": least}


def plan_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """In what two plans differ, a line each; none if they are the same.

    Args:
        before: From `fingerprint`, perhaps out of a file.
        now: From `fingerprint`.
    """
    old, new = flattened(before), flattened(now)
    return [
        f"{key}: {_shown(old, key)}, now {_shown(new, key)}"
        for key in dict.fromkeys((*old, *new))
        if _shown(old, key) != _shown(new, key)
    ]


def _shown(leaves: Mapping[str, Any], key: str) -> str:
    return str(leaves[key]) if key in leaves else "not there"


def _values(text: str) -> list[str]:
    """Split a text at commas, except those inside brackets or quotes."""
    values, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in _QUOTES:
            quote = letter
        else:
            depth += (letter in _OPENING) - (letter in _CLOSING)
        if letter == "," and not depth and not quote:
            values.append("")
        else:
            values[-1] += letter
    return [value.strip() for value in values]


def _same_place(first: str, second: str) -> bool:
    """Whether two dotted keys are the same, or one is of a section that the other is in."""
    return f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}.")


def _plain_clip(clip: Clip) -> dict[str, Any]:
    plain = _changed_fields(clip, Clip(clip.name, clip.recording, clip.room, clip.world))
    if clip.room is not None:
        plain |= {"room": _changed_fields(clip.room)}
    elif clip.world:
        plain |= {"world": description_hash(load_world(clip.world))}
    else:
        plain |= {"recording": clip.recording}
    if clip.camera is not None and Path(clip.camera).is_file():  # the same file wherever it lies
        plain["camera"] = hashlib.sha256(Path(clip.camera).read_bytes()).hexdigest()
    return plain


def _changed_fields(value: Any, default: Any = None) -> dict[str, Any]:
    """The fields of a dataclass that are not as in another, or as it is by default; nested ones likewise."""
    other = type(value)() if default is None else default
    found: dict[str, Any] = {}
    for field in dataclasses.fields(value):
        inner, usual = getattr(value, field.name), getattr(other, field.name)
        if inner != usual:
            nested = dataclasses.is_dataclass(inner) and dataclasses.is_dataclass(usual)
            plain = _changed_fields(inner, usual) if nested else inner
            found[field.name] = list(plain) if isinstance(plain, tuple) else plain
    return found
