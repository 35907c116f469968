"""The constant errors of a depth sensor are taken out of frames."""

from dataclasses import replace

import numpy as np
import pytest

from jaxslam import Camera, Frame
from jaxslam.errors import CameraError
from jaxslam.sensors.depth_correction import with_corrected_depth

CAMERA = Camera("small", 8, 8, 8.0, 8.0, 3.5, 3.5, depth_scale_per_m=1000.0, depth_offset_m=0.02, depth_delay_s=0.008)
DEPTH = np.full((8, 8), 1.5, np.float32)
DEPTH[0, :3] = 0, np.nan, 0.01
FRAME = Frame(10**9, np.zeros((8, 8), np.uint8), DEPTH)


def test_offset_and_delay() -> None:
    corrected = with_corrected_depth(FRAME, CAMERA)
    assert corrected.depth_m is not None
    assert corrected.depth_m.dtype == np.float32
    np.testing.assert_allclose(corrected.depth_m[1:], 1.48)
    np.testing.assert_array_equal(corrected.depth_m[0, :3], [0, 0, 0])  # missing, and nearer than the offset
    assert corrected.depth_delay_ns == 8_000_000
    assert with_corrected_depth(replace(FRAME, depth_timestamp_ns=10**9 - 10**6), CAMERA).depth_delay_ns == 7_000_000
    assert with_corrected_depth(replace(FRAME, played_backward=True), CAMERA).depth_delay_ns == -8_000_000


def test_nothing_to_correct() -> None:
    ideal = replace(CAMERA, depth_offset_m=0.0, depth_delay_s=0.0)
    assert with_corrected_depth(FRAME, ideal) is FRAME
    without = replace(FRAME, depth_m=None)
    assert with_corrected_depth(without, CAMERA) is without


def test_saved_and_loaded(tmp_path) -> None:
    CAMERA.save(tmp_path / "small.yaml")
    assert Camera.load(tmp_path / "small.yaml") == CAMERA


@pytest.mark.parametrize(("field", "value"), [("depth_offset_m", 20.0), ("depth_delay_s", 8.0)])
def test_other_units_are_refused(field: str, value: float) -> None:
    with pytest.raises(CameraError, match=field):
        replace(CAMERA, **{field: value})
