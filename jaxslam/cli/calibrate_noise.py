"""`jaxslam calibrate noise`: the noise of a camera, from an ordinary recording."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jaxslam.cli.console import console, make_table, print_json, progress_bar
from jaxslam.cli.run import OfRecording
from jaxslam.cli.shared_options import check_at_least
from jaxslam.errors import ConfigError

if TYPE_CHECKING:
    from jaxslam.calibration import NoiseCalibration

SETTINGS_FILE, FIGURES_FILE = "noise.yaml", "noise.json"


@dataclass(frozen=True)
class CalibrateNoise(OfRecording):
    """Options of `jaxslam calibrate noise`."""

    preset: str = "default"
    """Preset to track with."""
    rounds: int = 3
    """Track the recording at most this many times, each time forward and backward with the noise found before."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.calibration import calibrate_noise  # noqa: PLC0415
        from jaxslam.io.atomic_files import make_folder, write_atomically  # noqa: PLC0415

        check_at_least("--rounds", self.rounds, 1)
        config, dataset = self.settings(self.preset), self.opened()
        folder = self.out or Path("results") / "noise" / self.recording.resolve().name
        make_folder(folder, ConfigError)
        with progress_bar("{task.description}") as progress:
            task = progress.add_task("compiling the tracker", total=None)

            def on_progress(text: str, done: int, total: int) -> None:
                progress.update(task, description=text, completed=done, total=total)

            found = calibrate_noise(dataset, config, rounds=self.rounds, on_progress=on_progress)
        found.save(folder / SETTINGS_FILE)
        text = json.dumps(found.summary(), indent=2, allow_nan=False) + "\n"
        write_atomically(folder / FIGURES_FILE, text.encode(), ConfigError)
        if self.json:
            print_json({**found.summary(), "settings_file": str(folder / SETTINGS_FILE)})
            return
        _print(found, dataset.name)
        console.print(f"To use it: jaxslam run {self.recording} --config {folder / SETTINGS_FILE}")


def _print(found: "NoiseCalibration", name: str) -> None:
    table = make_table(name, "setting", "before", "after", "sigma", "of points", "verdict", left=1)
    for each in found.estimates:
        numbers = each.before, each.after, each.sigma, each.of_points
        cells = ("-" if math.isnan(value) else f"{value:.3g}" for value in numbers)
        table.add_row(f"track.{each.name}", *cells, each.verdict.value)
    console.print(table)
    console.print(
        f"Differences of {found.num_motions} motions, forward and backward, beside their covariances (1 if these are"
        f" right): {found.ratio_before:.2f} before, {found.ratio_after:.2f} in the last of {found.rounds} rounds."
    )
    if found.nees_before is not None and found.nees_after is not None:
        console.print(
            f"NEES against the ground truth: {found.nees_before:.2f} before, {found.nees_after:.2f} in the last round."
        )
