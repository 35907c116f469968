"""`jaxslam calibrate`: errors in one line. The page on calibration runs it."""

from pathlib import Path

import pytest
from command_line import failing
from tiny_recording import write_recording

fails = failing("calibrate")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "rgbd_dataset_freiburg1_tiny", count=3)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--rounds", "0"], "--rounds: expected at least 1, got 0"),
        (["--max-frames", "0"], "--max-frames: expected at least 1, got 0"),
        (["--focal-px", "-5"], "--focal-px: expected a number above 0, got -5"),
        (["--known-length", "nan"], "--known-length: expected a number above 0, got nan"),
        (["--known-length", "1", "--groundtruth"], "expected one source of scale"),
        (["--groundtruth"], "--groundtruth: expected a recording with ground truth"),
        (["--camera", "tum_fr9"], "camera: expected a known name or a YAML file"),
        (["--focal-px", "1"], "focal_px: Camera.fx: expected pixels that suit an image of 32"),
    ],
)
def test_wrong_options(
    capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path, options: list[str], problem: str
) -> None:
    assert problem in fails(capsys, str(recording), "--out", str(tmp_path / "out"), *options)
