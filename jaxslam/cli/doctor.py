"""`jaxslam doctor`: whether a recording is fit to be tracked."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.cli.console import console, print_json
from jaxslam.cli.shared_options import WithJson
from jaxslam.errors import DatasetError


@dataclass(frozen=True)
class Doctor(WithJson):
    """Options of `jaxslam doctor`."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of the recording."""
    dataset: str = "auto"
    """Kind of the recording, such as tum or kitti; auto recognizes it."""
    camera: str | None = None
    """Known camera or camera file."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.datasets.diagnostics import Level, diagnose  # noqa: PLC0415 - not for `--help`

        diagnosis = diagnose(self.recording, self.dataset, self.camera)
        if self.json:
            counts = {"errors": len(diagnosis.at(Level.ERROR)), "warnings": len(diagnosis.at(Level.WARNING))}
            print_json({"findings": [asdict(finding) for finding in diagnosis.findings], **counts})
        else:
            console.print(str(diagnosis), highlight=False, markup=False)
        if not diagnosis.ok:
            raise DatasetError(f"{self.recording}: not fit to be tracked, see the findings")
