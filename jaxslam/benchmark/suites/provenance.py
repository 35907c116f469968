"""Inputs of a run besides its settings: sources and libraries, recording, camera file, networks.

Each result keeps it, so that a later call knows whether the run would be the same now.
"""

import functools
import hashlib
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.system import System
from jaxslam.benchmark.suites.trajectory_folders import trajectories_of
from jaxslam.config.loading import configs_dir
from jaxslam.config.schema import Config, SemanticsConfig
from jaxslam.datasets.catalog import find_recording
from jaxslam.errors import BenchmarkError, ModelError
from jaxslam.io.download import sha256_of
from jaxslam.runtime.machine import machine
from jaxslam.runtime.trace_cache import source_files
from jaxslam.semantics.from_config import network_files
from jaxslam.worlds.library import load_world
from jaxslam.worlds.stored_world import description_hash

_MAX_HASHED_BYTES = 5_000_000
_HASHED = (".txt", ".yaml", ".csv")
_COMPUTED_BY = ("commit", "versions")


class Run(Protocol):
    """A run, as far as this module needs it: `jaxslam.benchmark.suites.job.Job`."""

    @property
    def clip(self) -> Clip:
        """Sequence that is tracked."""
        ...

    @property
    def config(self) -> Config:
        """Every setting of a run of jaxslam."""
        ...

    @property
    def system(self) -> System | None:
        """Other system whose trajectory is judged; `None` for a run of jaxslam."""
        ...

    @property
    def seed(self) -> int:
        """Number of the run."""
        ...


def identities(runs: Sequence[Run], root: Path | None) -> list[dict[str, Any]]:
    """Return the current inputs of runs; they are equal for equal figures on one kind of processor.

    Args:
        runs: Runs whose recordings are on this machine.
        root: Folder in which recordings are looked for first.

    Returns:
        For each: `commit` and `versions` of jaxslam and its libraries, `sources_sha256`, `data_sha256` of the
        recording, `camera_sha256` of a camera file, `networks_sha256`, and `system_sha256` of another system; `None`
        for what a run has not.
    """
    here = {key: value for key, value in machine().items() if key in _COMPUTED_BY}
    sources = sources_sha256()
    known = _Known(root)
    found = []
    for run in runs:
        system = run.system
        found.append(
            here
            | {
                "sources_sha256": sources,
                "data_sha256": known.input(run.clip),
                "camera_sha256": camera_sha256(run.clip),
                "networks_sha256": known.networks(run.config.semantics) if system is None else {},
                "system_sha256": None if system is None else system_sha256(system, run.clip, run.seed),
            }
        )
    return found


def changes(result: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Why a run would not give these figures again, in words; empty if it would, but for what seeds and clocks do.

    The sources decide, not the commit: a checkout with changes that are not committed is known by them.

    Args:
        result: Result of an earlier run.
        now: Its identity, from `identities`.
    """
    found = []
    if result.get("sources_sha256") != now["sources_sha256"]:
        before, here = (_version(each) for each in (result, now))
        found.append(f"jaxslam was {before}, is {here}" if before != here else f"the sources of jaxslam {here} changed")
    old = result.get("versions") or {}
    found += [
        f"{name} was {old.get(name)}, is {version}"
        for name, version in now["versions"].items()
        if name != "jaxslam" and old.get(name) != version
    ]
    if result.get("data_sha256") != now["data_sha256"]:
        found.append("the recording has changed, or is another one")
    if result.get("camera_sha256") != now["camera_sha256"]:
        found.append("the camera file has changed")
    if result.get("system_sha256") != now.get("system_sha256"):
        found.append("the trajectory, or a file that the command names, has changed")
    had, has = result.get("networks_sha256") or {}, now["networks_sha256"]
    for name in dict.fromkeys((*had, *has)):
        if had.get(name) != has.get(name):
            found.append(f"semantics.{name}: network was {_network(had, name)}, is {_network(has, name)}")
    return found


def sources_sha256() -> str:
    """Hash of the sources of jaxslam and its kernels, and of the cameras that come with it.

    Raises:
        BenchmarkError: If the package is not a folder of files.
    """
    files = source_files()
    if files is None:
        raise BenchmarkError("jaxslam: expected its sources in a folder, they are not")
    cameras = {file: file.name for file in sorted((configs_dir() / "cameras").glob("*"))}
    digest = hashlib.sha256()
    for file, name in (files | cameras).items():
        digest.update(f"{name}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def data_sha256(folder: Path) -> str:
    """A hash of the text files of a recording, and of names and sizes of the others."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        size = path.stat().st_size
        digest.update(f"{path.relative_to(folder)} {size}\n".encode())
        if path.suffix in _HASHED and size <= _MAX_HASHED_BYTES:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def world_sha256(world: str) -> str:
    """Hash of the description of a world and the files that it names.

    Raises:
        JaxSlamError: If there is no such world, or a file cannot be read.
    """
    return description_hash(load_world(world))


def camera_sha256(clip: Clip) -> str | None:
    """Hash of the camera file of a sequence; `None` if it names none, or a known camera."""
    return sha256_of(Path(clip.camera)) if clip.camera is not None and Path(clip.camera).is_file() else None


def system_sha256(system: System, clip: Clip, number: int) -> str:
    """Hash of the trajectory of another system, or of the files that its command names, such as a script.

    Args:
        system: The other system.
        clip: Sequence that it tracks.
        number: Number of the run.
    """
    digest = hashlib.sha256()
    if system.trajectories:
        files = trajectories_of(Path(system.trajectories), clip)[number : number + 1]
    else:
        named = (Path(system.folder, word) for word in shlex.split(system.command))
        files = [file for file in named if file.is_file()]
    for file in files:
        digest.update(f"{file.name} {sha256_of(file)}\n".encode())
    return digest.hexdigest()


def networks_sha256(config: SemanticsConfig) -> dict[str, str | None]:
    """Hashes of the networks of a run by the settings that name them; `None` for one that is not on this machine.

    Raises:
        ModelError: If a file is named that is not there.
    """
    return {setting: path and sha256_of(path) for setting, path in network_files(config).items()}


def _networks_or_problem(config: SemanticsConfig) -> dict[str, str | None]:
    """Return `networks_sha256`; a named file that does not exist is left for the run to report."""
    try:
        return networks_sha256(config)
    except ModelError as problem:
        return {"model": str(problem)}


def _version(result: Mapping[str, Any]) -> str:
    return result.get("commit") or (result.get("versions") or {}).get("jaxslam") or "of unknown version"


def _network(hashes: Mapping[str, str | None], name: str) -> str:
    if name not in hashes:
        return "none"
    return f"{hashes[name]:.12}" if hashes[name] else "not on the machine"


class _Known:
    """Hashes and folders that were asked for: what they are of does not change within a call of a command."""

    def __init__(self, root: Path | None) -> None:
        """With the folder in which recordings are looked for first."""
        self._folder = functools.cache(lambda recording: find_recording(recording, root))
        self._data = functools.cache(data_sha256)
        self._world = functools.cache(world_sha256)
        self.networks = functools.cache(_networks_or_problem)

    def input(self, clip: Clip) -> str | None:
        """Hash of the recording or the world of a sequence; `None` for a room, or what is not on this machine."""
        if clip.world:
            return self._world(clip.world)
        folder = self._folder(clip.recording) if clip.recording else None
        return None if folder is None else self._data(folder)
