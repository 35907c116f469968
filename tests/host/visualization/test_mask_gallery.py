"""Pictures of masks: which frames are kept, what is drawn, and the files."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxslam.errors import JaxSlamError
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.mask_pipeline import MaskSource
from jaxslam.tracking.state import KeyframeReason, TrackStatus
from jaxslam.visualization.mask_gallery import MASK_RGB, MaskPictures, draw_mask, write_mask_pictures

HEIGHT, WIDTH = 60, 80
BAR = 20
"""Height of the line of words, pixels."""


def frame_of(level: int, *, gray: bool = False) -> Frame:
    shape = (HEIGHT, WIDTH) if gray else (HEIGHT, WIDTH, 3)
    return Frame(0, np.full(shape, level, np.uint8), np.ones((HEIGHT, WIDTH), np.float32))


def tracked(mask: np.ndarray, source: MaskSource = MaskSource.DETECTOR, age: int = 2) -> FrameResult:
    """A result of which only the mask matters."""
    nothing, pose = np.zeros(0, np.float32), np.array([1.0, 0, 0, 0, 0, 0, 0])
    return FrameResult(
        **dict.fromkeys(("timestamp_ns", "num_inliers", "inlier_ratio", "num_keyframe_matches", "num_matched"), 0),
        **{"T_world_cam": pose, "correction": pose, "covariance": np.eye(6), "twist": np.zeros(6)},
        **{"uv": np.zeros((2, 0), np.float32), "weights": nothing, "followed": nothing.astype(bool)},
        **{"status": TrackStatus.OK, "reason": "", "keyframe": KeyframeReason.NONE, "residual_px": 0.0},
        **{"detector_error": "", "track_ms": 0.0},
        dynamic_mask=mask,
        mask_source=source,
        mask_age=age,
    )


def left_half() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2] = True
    return mask


def levels(pictures: list[np.ndarray]) -> list[int]:
    """The gray level outside the mask, by which a test knows a frame again."""
    return [int(picture[-1, -1, 0]) for picture in pictures]


class TestWhichAreKept:
    def watch(self, count: int, most: int) -> list[int]:
        pictures = MaskPictures(most)
        for level in range(count):
            pictures(frame_of(level), tracked(left_half()))
        return levels(pictures.kept)

    @pytest.mark.parametrize("count", [0, 1, 7, 8])
    def test_all_of_few(self, count: int) -> None:
        assert self.watch(count, most=8) == list(range(count))

    @pytest.mark.parametrize("count", [9, 16, 17, 100, 250])
    def test_evenly_of_many(self, count: int) -> None:
        kept = self.watch(count, most=8)
        assert 4 <= len(kept) <= 8
        one_of = next(n for n in (2, 4, 8, 16, 32) if count <= 8 * n)
        assert [level // one_of for level in kept] == list(range(len(kept)))
        assert kept[-1] >= count - 2 * one_of

    def test_not_in_step_with_a_detector(self) -> None:
        """Of frames that come from the detector and from propagation in turn, both are among those kept."""
        parities = {level % 2 for level in self.watch(200, most=16)}
        assert parities == {0, 1}

    def test_only_frames_with_something_in_the_mask(self) -> None:
        pictures, nothing = MaskPictures(), np.zeros((HEIGHT, WIDTH), bool)
        pictures(frame_of(1), tracked(nothing))
        pictures(None, tracked(left_half()))
        pictures(frame_of(2), Rejected(0, JaxSlamError("wrong")))
        assert pictures.kept == []
        pictures(frame_of(3), tracked(left_half()))
        assert levels(pictures.kept) == [3]


class TestPicture:
    @pytest.mark.parametrize("source", list(MaskSource))
    def test_mask_has_the_color_of_its_source(self, source: MaskSource) -> None:
        picture = draw_mask(frame_of(100).image, tracked(left_half(), source), "frame 3")
        assert (picture.shape, picture.dtype) == ((240 + BAR, 320, 3), np.uint8)
        color = np.array(MASK_RGB[source])
        np.testing.assert_array_equal(picture[BAR + 120, 80], np.round((100 + color) / 2))
        np.testing.assert_array_equal(picture[BAR:, 162:], 100)
        np.testing.assert_array_equal(picture[1, 318], color)
        assert (picture[:BAR] == 0).all(axis=2).sum() > 50  # words

    def test_colors_are_told_apart(self) -> None:
        colors = np.array(list(MASK_RGB.values()), float)
        apart = np.linalg.norm(colors[:, None] - colors[None], axis=2)
        assert apart[~np.eye(len(colors), dtype=bool)].min() > 60

    def test_words_differ(self) -> None:
        draw = lambda age, title: draw_mask(frame_of(100).image, tracked(left_half(), age=age), title)[:BAR]
        assert (draw(2, "frame 3") != draw(3, "frame 3")).any()
        assert (draw(2, "frame 3") != draw(2, "frame 4")).any()
        assert (draw(-1, "frame 3") != draw(1, "frame 3")).any()

    def test_gray_and_source_untouched(self) -> None:
        frame = frame_of(100, gray=True)
        picture = draw_mask(frame.image, tracked(left_half()), "frame 0")
        np.testing.assert_array_equal(picture, draw_mask(frame_of(100).image, tracked(left_half()), "frame 0"))
        assert (frame.image == 100).all()


class TestFiles:
    def pictures(self, count: int) -> list[np.ndarray]:
        mask = left_half()
        return [draw_mask(frame_of(2 * k).image, tracked(mask), f"frame {k}") for k in range(count)]

    @pytest.mark.parametrize(("count", "columns", "rows"), [(1, 1, 1), (3, 3, 1), (6, 4, 2), (40, 4, 3)])
    def test_sheet_and_animation(self, tmp_path: Path, count: int, columns: int, rows: int) -> None:
        write_mask_pictures(tmp_path, self.pictures(count))
        assert {path.name for path in tmp_path.iterdir()} == {"masks.gif", "masks.png"}
        with Image.open(tmp_path / "masks.png") as sheet:
            assert sheet.size == (320 * columns, 260 * rows)
        with Image.open(tmp_path / "masks.gif") as animation:
            assert animation.size == (320, 260)
            assert getattr(animation, "n_frames", 1) == count
            shown = np.asarray(animation.convert("RGB"))
        expected = np.array(MASK_RGB[MaskSource.DETECTOR]) / 2
        assert np.abs(shown[BAR + 120, 80] - expected).max() < 16

    @pytest.mark.slow
    def test_animation_stays_small(self, tmp_path: Path) -> None:
        """Noise does not compress: fewer frames of it fit."""
        random = np.random.default_rng(0)
        noise = [random.integers(0, 256, (260, 320, 3), np.uint8) for _ in range(60)]
        write_mask_pictures(tmp_path, noise)
        assert 1_000_000 < (tmp_path / "masks.gif").stat().st_size <= 3_000_000

    def test_folder_that_is_not_there(self, tmp_path: Path) -> None:
        with pytest.raises(JaxSlamError, match=r"masks\.png: cannot be written"):
            write_mask_pictures(tmp_path / "nowhere", self.pictures(2))
