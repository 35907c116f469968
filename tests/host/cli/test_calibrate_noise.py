"""`jaxslam calibrate noise`: errors in one line. The page on noise runs it."""

from pathlib import Path

import pytest
from command_line import failing
from tiny_recording import write_recording

fails = failing("calibrate", "noise")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ([], "expected at least 40 frames, got 3"),
        (["--rounds", "0"], "--rounds: expected at least 1, got 0"),
        (["--max-frames", "0"], "--max-frames: expected at least 1, got 0"),
        (["--set", "track.pixel_sigma=0"], "track.pixel_sigma"),
        (["--camera", "tum_fr9"], "camera: expected a known name or a YAML file"),
    ],
)
def test_wrong_options(capsys: pytest.CaptureFixture[str], tmp_path: Path, options: list[str], problem: str) -> None:
    recording = write_recording(tmp_path / "rgbd_dataset_freiburg1_tiny", count=3)
    assert problem in fails(capsys, str(recording), "--out", str(tmp_path / "out"), *options)
