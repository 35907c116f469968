"""`jaxslam world list`, `show` and `render`: worlds described by data, seen and made into recordings."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from jaxslam.cli.console import make_table, plain_console, print_json, progress_bar
from jaxslam.cli.shared_options import WithJson

if TYPE_CHECKING:
    from jaxslam.worlds.recording import WorldRecording

_Name = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]


@dataclass(frozen=True)
class ListWorlds(WithJson):
    """Options of `jaxslam world list`."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.worlds.library import load_world, worlds  # noqa: PLC0415 - loads JAX

        known = {name: load_world(name) for name in worlds()}
        if self.json:
            print_json([{"name": name, "about": each.about, "seconds": each.seconds} for name, each in known.items()])
            return
        table = make_table("Worlds", "name", "about", "seconds", left=2)
        for name, each in known.items():
            table.add_row(name, each.about, f"{each.seconds:g}")
        plain_console.print(table)
        plain_console.print("To look at one: jaxslam world show NAME; a YAML file of your own will do too.")


@dataclass(frozen=True)
class ShowWorld(WithJson):
    """Options of `jaxslam world show`."""

    name: _Name
    """Name of a world, as `world list` prints it, or a YAML file."""
    out: Path | None = None
    """Folder of the pictures; `results/worlds/` and the name if not given."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.visualization.world_pictures import write_world_pictures  # noqa: PLC0415 - loads JAX

        recording = _opened(self.name, stored=True)
        folder = self.out or Path("results") / "worlds" / recording.name
        with progress_bar("Rendering") as progress:
            task = progress.add_task("", total=None)
            files = write_world_pictures(
                recording, folder, lambda done, total: progress.update(task, completed=done, total=total)
            )
        if self.json:
            print_json({**_figures(recording), "files": [str(file) for file in files]})
            return
        for name, value in _figures(recording).items():
            plain_console.print(f"{name}: {value}")
        for file in files:
            plain_console.print(str(file))


@dataclass(frozen=True)
class RenderWorld:
    """Options of `jaxslam world render`."""

    name: _Name
    """Name of a world, as `world list` prints it, or a YAML file."""
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the recording; it must not exist, or be empty."""
    layout: Literal["tum", "euroc", "kitti"] | None = None
    """Layout of its files: that of TUM RGB-D, EuRoC MAV or KITTI odometry. By default tum with a depth camera, euroc
    with a stereo pair and an IMU, kitti with a stereo pair alone."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.datasets.synthetic.write_recording import write_recording  # noqa: PLC0415 - loads JAX

        recording = _opened(self.name, stored=False)
        with progress_bar("Rendering") as progress:
            task = progress.add_task("", total=len(recording))
            to_open = write_recording(
                recording,
                self.folder,
                self.layout,
                lambda done, total: progress.update(task, completed=done, total=total),
                texts={"labels.txt": recording.labels_text()},
            )
        plain_console.print(f"{len(recording)} frames: {self.folder}")
        plain_console.print(f"To track it: jaxslam run {to_open}")


def _opened(name: str, *, stored: bool) -> "WorldRecording":
    """Open a world; frames that are likely to be looked at again are stored."""
    from jaxslam.runtime.compile_cache import enable_compile_cache  # noqa: PLC0415 - loads JAX
    from jaxslam.worlds.recording import WorldRecording  # noqa: PLC0415
    from jaxslam.worlds.stored_world import StoredWorld  # noqa: PLC0415

    enable_compile_cache()
    return StoredWorld(name) if stored else WorldRecording(name)


def _figures(recording: "WorldRecording") -> dict[str, Any]:
    """Return the figures of a world that are printed."""
    camera, world = recording.camera, recording.world
    counts = Counter(recording.labels)
    return {
        "about": world.about,
        "frames": len(recording),
        "seconds": world.seconds,
        "camera": f"{camera.width}x{camera.height}, {'stereo' if camera.is_stereo else 'RGB-D'}, {camera.fps:g} fps",
        "rooms": len(world.rooms),
        "things and people": ", ".join(f"{count} {label}" for label, count in sorted(counts.items())),
    }
