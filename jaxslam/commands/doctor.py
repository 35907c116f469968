"""`jaxslam doctor`: whether a recording is fit to be tracked."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.commands.console import console
from jaxslam.doctor import diagnose
from jaxslam.errors import DatasetError


@dataclass(frozen=True)
class Doctor:
    """Look a recording over before tracking it: files, times, calibration, depth scale, picture quality."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of the recording."""
    dataset: str = "auto"
    """Kind of the recording: auto, tum, bonn."""
    camera: str | None = None
    """Known camera or camera file."""

    def main(self) -> None:
        """Run the command."""
        diagnosis = diagnose(self.recording, self.dataset, self.camera)
        console.print(str(diagnosis), highlight=False, markup=False)
        if not diagnosis.ok:
            raise DatasetError(f"{self.recording}: not fit to be tracked, see above")
