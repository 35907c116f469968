"""`jaxslam bench soak`: hours of tracking in one place, and what grows meanwhile."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.table import Table

from jaxslam.cli.console import console, make_table, print_json, progress_bar
from jaxslam.cli.shared_options import Settings, WithJson, check_at_least, flat, image_size
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import make_folder

if TYPE_CHECKING:
    from jaxslam.benchmark.soak.meter import Window
    from jaxslam.benchmark.soak.recordings import Covered
    from jaxslam.config.schema import Config
    from jaxslam.semantics import Detector
    from jaxslam.worlds.passing_people import PassingPeople

_CACHE_BYTES = 8 << 30
"""Size that rendered frames may take in the user's cache: four minutes of 320x240 pixels, as `flat_visits` has."""

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Soak(WithJson):
    """Options of `jaxslam bench soak`."""

    recording: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")] = "flat_visits"
    """Folder of a recording, or a world: the name of one, or a YAML file."""
    frames: int = 100_000
    """Number of frames."""
    window: int = 1500
    """Number of frames that are summed up in a row."""
    preset: str = "default"
    """Preset to start from."""
    people: int = 4
    """Number of people in a world, other ones each time that it is walked through. A recording has its own."""
    size: str = "320x240"
    """Width and height of the images of a world, in pixels."""
    covered_every: int = 4000
    """Number of frames after which something is before the lens for half a second; 0 for never."""
    detector_fails: float = 0.01
    """Share of the calls of the detector that fail."""
    live: bool = False
    """Give each module its own thread, and frames as fast as they are tracked; otherwise all run in turn."""
    realtime: bool = False
    """Give each module its own thread, and frames at the rate of the recording. Late frames are dropped."""
    out: Path = Path("results") / "bench" / "soak"
    """Folder for the table, the plot, and the figures. Those of an earlier test are replaced."""
    set: Settings = ()
    """Settings, such as `--set mapping.max_mb=200`. Repeatable."""

    def main(self) -> None:
        """Run the command."""
        self._check()
        from jaxslam.benchmark.reports.soak import markdown_report, picture, summary  # noqa: PLC0415
        from jaxslam.benchmark.soak.meter import SoakMeter  # noqa: PLC0415
        from jaxslam.cli.measurement_files import write_measurements  # noqa: PLC0415
        from jaxslam.config.loading import load_config  # noqa: PLC0415
        from jaxslam.runtime.compile_cache import enable_compile_cache  # noqa: PLC0415
        from jaxslam.runtime.machine import machine  # noqa: PLC0415
        from jaxslam.slam.slam import Slam  # noqa: PLC0415

        enable_compile_cache()
        threads = ("run.deterministic=false",) if self.live else ()
        rate = ("run.realtime=true",) if self.realtime else ()
        config = load_config(self.preset, None, (*threads, *rate, *flat(self.set)))
        recording, detector = self._opened(config)
        make_folder(self.out, BenchmarkError)
        with Slam(recording.camera, config, detector=detector) as slam:
            meter = SoakMeter(slam, recording.ground_truth, self.window, recording.may_be_lost, self.out / "soak.csv")
            with progress_bar("{task.description}") as progress:
                bar = progress.add_task("soak", total=self.frames)

                def on_frame(frame: Any, result: Any) -> None:
                    meter(frame, result)
                    progress.advance(bar)

                slam.run(recording, on_frame)
            meter.end_window()
        content = {
            **machine(),
            "recording": recording.name,
            "preset": self.preset,
            "live": not config.run.in_turn,
            "realtime": config.run.realtime,
            "frames": self.frames,
            "window": self.window,
            "covered_every": self.covered_every,
            "detector_fails": self.detector_fails if detector is not None else None,
            **summary(meter.windows),
            "windows": [asdict(window) for window in meter.windows],
        }
        if self.json:
            print_json(content)
        else:
            console.print(windows_table(meter.windows))
        write_measurements(self.out, "soak", content, markdown_report(content), picture(content))

    def _check(self) -> None:
        for name, value, least in (
            ("frames", self.frames, 3),
            ("window", self.window, 3),
            ("people", self.people, 1),
            ("covered-every", self.covered_every, 0),
        ):
            check_at_least(f"--{name}", value, least)
        if not 0 <= self.detector_fails <= 1:
            raise BenchmarkError(f"--detector-fails: expected a share from 0 to 1, got {self.detector_fails:g}")

    def _opened(self, config: "Config") -> "tuple[Covered, Detector | None]":
        """Open the recording, and what detects people in it; a world's own detector sees the truth."""
        from jaxslam.benchmark.soak.recordings import Covered, FailingDetector, WithPeople  # noqa: PLC0415
        from jaxslam.datasets import open_dataset  # noqa: PLC0415
        from jaxslam.datasets.to_and_fro import ToAndFro  # noqa: PLC0415
        from jaxslam.semantics.from_config import detector_of  # noqa: PLC0415
        from jaxslam.worlds.library import worlds  # noqa: PLC0415

        if self.recording in worlds() or Path(self.recording).suffix == ".yaml":
            played = WithPeople(self._people(), self.frames)
            detector: Detector | None = None if config.semantics.model is None else played.detect
        else:
            played = ToAndFro(open_dataset(Path(self.recording)), self.frames)
            detector = detector_of(config.semantics, config.run.threads)
        if detector is not None and self.detector_fails:
            detector = FailingDetector(detector, self.detector_fails, config.run.seed)
        return Covered(played, self.covered_every), detector

    def _people(self) -> "PassingPeople":
        """Open the world without its own people, for others."""
        from jaxslam.worlds.library import load_world  # noqa: PLC0415
        from jaxslam.worlds.passing_people import PassingPeople, without_people  # noqa: PLC0415
        from jaxslam.worlds.stored_world import StoredWorld  # noqa: PLC0415

        width, height = image_size(self.size)
        world = without_people(load_world(self.recording))
        if world.camera.baseline_m:
            raise BenchmarkError(f"'{self.recording}': expected a world with a depth camera, got a stereo pair")
        world = replace(world, camera=replace(world.camera, width=width, height=height))
        return PassingPeople(StoredWorld(world, limit_bytes=_CACHE_BYTES), self.people)


def windows_table(windows: "Sequence[Window]") -> Table:
    """Make a table of windows for a terminal: at most some twenty of them, evenly spread."""
    from jaxslam.benchmark.reports.soak import COLUMNS, cells  # noqa: PLC0415

    shown = windows[:: max(len(windows) // 20, 1)]
    return make_table("Soak", *COLUMNS, rows=[cells(asdict(window)) for window in shown], gap=1)
