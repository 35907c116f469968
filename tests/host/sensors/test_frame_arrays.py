"""Frames as the compiled step takes them."""

import dataclasses

import numpy as np
import pytest

from jaxslam import Frame, frame_arrays, stack_frames
from jaxslam.errors import FrameError
from jaxslam.sensors.frame_arrays import FrameMemory

MS = 1_000_000


def frame(time_ms: int, size: tuple[int, int] = (6, 4), **fields) -> Frame:
    image = np.full((*size[::-1], 3), time_ms % 256, np.uint8)
    return Frame(time_ms * MS, image, np.full(size[::-1], 1.5, np.float32), **fields)


class TestFrameArrays:
    def test_color_becomes_gray_and_nothing_is_ignored(self) -> None:
        arrays = frame_arrays(frame(100), 0.1)
        np.testing.assert_array_equal(arrays.image, np.full((4, 6), 100, np.uint8))
        assert not np.any(arrays.ignore)
        assert [array.dtype for array in arrays[:5]] == [np.uint8, np.float32, bool, np.float32, np.float32]
        assert arrays.right is None
        assert arrays.movable is None
        assert (float(arrays.dt_s), float(arrays.depth_delay_s)) == (pytest.approx(0.1), 0)

    def test_mask_and_delay(self) -> None:
        mask = np.eye(4, 6, dtype=bool)
        arrays = frame_arrays(frame(100, dynamic_mask=mask, depth_timestamp_ns=92 * MS), 0.1)
        np.testing.assert_array_equal(arrays.ignore, mask)
        assert float(arrays.depth_delay_s) == pytest.approx(-0.008)

    def test_sign_of_the_readout(self) -> None:
        signs = [frame_arrays(frame(100, played_backward=way), 0.1).readout_sign for way in (False, True)]
        assert [float(sign) for sign in signs if sign is not None] == [1, -1]

    def test_depth_is_not_copied(self) -> None:
        given = frame(100)
        assert frame_arrays(given, 0.1).depth is given.depth_m

    def test_double_precision(self) -> None:
        arrays = frame_arrays(frame(100), 0.1, np.float64)
        assert {array.dtype for array in arrays[:5]} == {np.dtype("uint8"), np.dtype("bool"), np.dtype("float64")}


class TestFrameMemory:
    def test_the_kept_frame_stays(self) -> None:
        memory = FrameMemory(4, 6)
        first = memory.hold(frame(100), 0.1)
        memory.keep()
        for time_ms in (130, 160):  # lost: not kept
            memory.hold(frame(time_ms), 0.1)
            np.testing.assert_array_equal(first.image, np.full((4, 6), 100))
        second = memory.hold(frame(190), 0.1)
        memory.keep()
        memory.hold(frame(220), 0.1)
        np.testing.assert_array_equal(second.image, np.full((4, 6), 190))
        assert not np.array_equal(first.image, np.full((4, 6), 100))


class TestStackFrames:
    def test_time_is_the_first_axis(self) -> None:
        clip = stack_frames([frame(100), frame(130), frame(190)])
        assert clip.image.shape == clip.depth.shape == clip.ignore.shape == (3, 4, 6)
        np.testing.assert_allclose(clip.dt_s, [0.03, 0.03, 0.06], rtol=1e-6)
        np.testing.assert_array_equal(clip.image[:, 0, 0], [100, 130, 190])

    def test_pairs(self) -> None:
        pair = dataclasses.replace(frame(100), right=np.full((4, 6, 3), 50, np.uint8))
        clip = stack_frames([pair, dataclasses.replace(pair, timestamp_ns=130 * MS)])
        assert clip.right is not None
        assert clip.right.shape == (2, 4, 6)
        with pytest.raises(FrameError, match="expected stereo pairs or frames with depth, got both"):
            stack_frames([pair, frame(130)])

    def test_goes_on_after_a_clip(self) -> None:
        clip = stack_frames([frame(100), frame(130)], previous_ns=60 * MS)
        np.testing.assert_allclose(clip.dt_s, [0.04, 0.03], rtol=1e-6)

    @pytest.mark.parametrize(
        ("frames", "message"),
        [([], "at least one"), ([frame(1), frame(2, (8, 4))], r"one size, got \[\(6, 4\), \(8, 4\)\]")],
    )
    def test_bad_frames_are_refused(self, frames: list[Frame], message: str) -> None:
        with pytest.raises(FrameError, match=message):
            stack_frames(frames)
