"""`jaxslam calibrate`: the camera of a recording, from the recording itself."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxslam.cli.console import console, make_table, print_json, progress_bar
from jaxslam.cli.shared_options import Settings, WithJson, check_at_least, flat
from jaxslam.errors import ConfigError

if TYPE_CHECKING:
    from jaxslam.calibration import Calibration, Estimate
    from jaxslam.datasets import Dataset
    from jaxslam.trajectory import Trajectory

# Heavy modules are imported where a command runs: `--help` needs none of them.

CAMERA_FILE, FIGURES_FILE, PICTURE_FILE = "camera.yaml", "calibration.json", "residuals.png"


@dataclass(frozen=True)
class Calibrate(WithJson):
    """Options of `jaxslam calibrate`."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of the recording."""
    dataset: str = "auto"
    """Kind of the recording, such as tum or kitti; auto recognizes it."""
    camera: str | None = None
    """Known camera or camera file to begin with; if not given, camera.yaml in the folder, or a guess."""
    focal_px: float | None = None
    """Focal length to begin with, pixels; without this or any camera, that of a field of view of 60 degrees."""
    depth_scale: float | None = None
    """Counts of the depth images per meter, where no camera says so; 5000 for recordings in the layout of TUM."""
    known_length: float | None = None
    """Distance between the first and the last place of the camera by a tape, meters; tells the scale of depth."""
    groundtruth: bool = False
    """Take the scale of depth from the true trajectory of the recording."""
    preset: str = "default"
    """Preset to track with."""
    config: Path | None = None
    """YAML file of settings that differ from the preset."""
    out: Path | None = None
    """Folder for the camera file, the figures and the picture; results/calibration/NAME if not given."""
    max_frames: int | None = None
    """Use at most this many frames."""
    start: int = 0
    """First frame to use."""
    rounds: int = 3
    """Track the recording at most this many times, each time with the camera found before."""
    set: Settings = ()
    """Settings, as in `--set track.num_points=400`; may be given again."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.calibration import calibrate, open_with_start  # noqa: PLC0415
        from jaxslam.config.loading import load_config  # noqa: PLC0415
        from jaxslam.io.atomic_files import make_folder, write_atomically  # noqa: PLC0415
        from jaxslam.visualization.calibration_plot import plot_calibration  # noqa: PLC0415

        self._check()
        config = load_config(self.preset, self.config, flat(self.set))
        opened, source = open_with_start(
            self.recording, self.dataset, self.camera, focal_px=self.focal_px, depth_scale_per_m=self.depth_scale
        )
        dataset = self._part(opened)
        folder = self.out or Path("results") / "calibration" / self.recording.resolve().name
        make_folder(folder, ConfigError)
        console.print(f"Begins with {source}: fx {dataset.camera.fx:.1f}, fy {dataset.camera.fy:.1f} pixels.")
        with progress_bar("{task.description}") as progress:
            task = progress.add_task("compiling the tracker", total=None)

            def on_progress(text: str, done: int, total: int) -> None:
                progress.update(task, description=text, completed=done, total=total or None)

            found = calibrate(dataset, config, rounds=self.rounds, scale=self._scale(dataset), on_progress=on_progress)
        found.camera.save(folder / CAMERA_FILE)
        figures = {"start": source, **found.summary()}
        text = json.dumps(figures, indent=2, allow_nan=False) + "\n"
        write_atomically(folder / FIGURES_FILE, text.encode(), ConfigError)
        plot_calibration(found, folder / PICTURE_FILE, title=dataset.name)
        if self.json:
            print_json({**figures, "camera_file": str(folder / CAMERA_FILE)})
            return
        _print(found, dataset.name)
        console.print(f"To use it: jaxslam run {self.recording} --camera {folder / CAMERA_FILE}")

    def _check(self) -> None:
        check_at_least("--rounds", self.rounds, 1)
        if self.max_frames is not None:
            check_at_least("--max-frames", self.max_frames, 1)
        for option, value in (
            ("--focal-px", self.focal_px),
            ("--depth-scale", self.depth_scale),
            ("--known-length", self.known_length),
        ):
            if value is not None and not value > 0:
                raise ConfigError(f"{option}: expected a number above 0, got {value:g}")
        if self.groundtruth and self.known_length is not None:
            raise ConfigError("--known-length: expected one source of scale, got --groundtruth too")

    def _part(self, dataset: "Dataset") -> "Dataset":
        from jaxslam.datasets import Subset  # noqa: PLC0415

        if not self.start and self.max_frames is None:
            return dataset
        return Subset(dataset, self.start, None if self.max_frames is None else self.start + self.max_frames)

    def _scale(self, dataset: "Dataset") -> "float | Trajectory | None":
        if not self.groundtruth:
            return self.known_length
        truth = dataset.ground_truth
        if truth is None:
            raise ConfigError(f"--groundtruth: expected a recording with ground truth, {dataset.name} has none")
        return truth


def _print(found: "Calibration", name: str) -> None:
    table = make_table(name, "parameter", "before", "after", "found", "sigma", "verdict", left=1)
    for estimate in found.estimates:
        table.add_row(*_cells(estimate))
    console.print(table)
    console.print(
        f"Held-out frames cost {100 * found.held_out_gain:.1f} % less, in {found.num_blocks} parts of the recording"
        f" with {found.num_frames} frames, tracked {found.rounds} times. Standard deviations (sigma) are lower bounds:"
        " errors that all of its parts share do not show in them."
    )


def _cells(estimate: "Estimate") -> tuple[str, ...]:
    digits = 2 if estimate.unit in ("px", "1/m") else 5
    numbers: list[Any] = [estimate.before, estimate.after, estimate.found, estimate.sigma]
    texts = ["-" if math.isnan(number) else f"{number:.{digits}f}" for number in numbers]
    unit = f" [{estimate.unit}]" if estimate.unit else ""
    return (f"{estimate.name}{unit}", *texts, estimate.verdict.value)
