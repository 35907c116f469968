"""A frame's structure is checked when it is made; its content is not."""

import numpy as np
import pytest

from jaxslam.errors import FrameError
from jaxslam.sensors.frame import Frame, check_frame, to_gray

HEIGHT, WIDTH = 12, 16
RGB = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
DEPTH = np.full((HEIGHT, WIDTH), 2.0, np.float32)


def make(**fields: object) -> Frame:
    return Frame(**({"timestamp_ns": 5, "image": RGB, "depth_m": DEPTH} | fields))  # type: ignore[arg-type]


class TestStructure:
    @pytest.mark.parametrize("image", [RGB, RGB[..., 0], RGB[..., ::-1]], ids=["rgb", "gray", "view"])
    @pytest.mark.parametrize("mask", [None, np.zeros((HEIGHT, WIDTH), bool)], ids=["no mask", "mask"])
    def test_accepts(self, image: np.ndarray, mask: np.ndarray | None) -> None:
        assert make(image=image, dynamic_mask=mask).size == (WIDTH, HEIGHT)

    @pytest.mark.parametrize("time", [0, -3, np.int64(1_548_339_819_874_260_000)])
    def test_accepts_any_integer_time(self, time: int) -> None:
        assert make(timestamp_ns=time).timestamp_ns == time

    @pytest.mark.parametrize(
        ("field", "value", "words"),
        [
            ("timestamp_ns", 1548339819.87, "int in nanoseconds, got 1548339819.87 seconds?"),
            ("timestamp_ns", float("nan"), "int in nanoseconds, got nan"),
            ("timestamp_ns", "5", "int in nanoseconds, got '5'"),
            ("timestamp_ns", True, "got True"),
            ("timestamp_ns", 2**63, "fits 64 bits"),
            ("image", RGB.tolist(), "uint8, got list"),
            ("image", RGB.astype(np.float32) / 255, "uint8, got float32; scale it to 0 to 255"),
            ("image", RGB.astype(np.uint16), "uint8, got uint16"),
            ("image", np.zeros((HEIGHT, WIDTH, 4), np.uint8), "got shape (12, 16, 4); drop the alpha"),
            ("image", np.zeros((HEIGHT, WIDTH, 1), np.uint8), "got shape (12, 16, 1)"),
            ("image", np.zeros((0, 0, 3), np.uint8), "got shape (0, 0, 3)"),
            ("depth_m", [[1.0]], "float32, got list"),
            (
                "depth_m",
                (DEPTH * 5000).astype(np.uint16),
                "got uint16; divide the counts by the camera's depth_scale",
            ),
            ("depth_m", DEPTH.astype(np.float64), "got float64; use astype(numpy.float32)"),
            ("depth_m", DEPTH[..., None], "got shape (12, 16, 1)"),
            ("depth_m", DEPTH[:6], "the image's 16x12 pixels, got 16x6"),
            ("dynamic_mask", np.zeros((HEIGHT, WIDTH), np.uint8), "bool, got uint8; use mask > 0"),
            ("dynamic_mask", np.zeros((HEIGHT, 8), bool), "the image's 16x12 pixels, got 8x12"),
        ],
    )
    def test_refuses(self, field: str, value: object, words: str) -> None:
        with pytest.raises(FrameError) as error:
            make(**{field: value})
        assert str(error.value).startswith(f"{field}: expected ")
        assert words in str(error.value)

    @pytest.mark.parametrize(
        "content",
        [
            {"image": np.zeros_like(RGB)},
            {"image": np.full_like(RGB, 255)},
            {"depth_m": None},
            {"depth_m": np.zeros_like(DEPTH)},
            {"depth_m": np.full_like(DEPTH, np.nan)},
            {"depth_m": np.full_like(DEPTH, np.inf)},
            {"depth_m": -DEPTH},
            {"dynamic_mask": np.ones((HEIGHT, WIDTH), bool)},
        ],
        ids=["black", "white", "no image", "no depth", "NaN", "infinite", "negative depth", "all dynamic"],
    )
    def test_leaves_content_to_the_tracker(self, content: dict[str, np.ndarray]) -> None:
        make(**content)


class TestCheckFrame:
    def test_accepts_what_fits(self) -> None:
        check_frame(make(), WIDTH, HEIGHT)

    def test_refuses_another_size(self) -> None:
        with pytest.raises(FrameError, match="image: expected the camera's 12x16 pixels, got 16x12"):
            check_frame(make(), HEIGHT, WIDTH)


class TestToGray:
    def test_weighs_red_green_and_blue(self) -> None:
        expected = RGB @ np.array([0.299, 0.587, 0.114])
        assert np.abs(to_gray(RGB) - expected).max() <= 0.51
        assert to_gray(RGB).dtype == np.uint8

    def test_takes_views(self) -> None:
        np.testing.assert_array_equal(to_gray(RGB[::2, ::-1]), to_gray(RGB[::2, ::-1].copy()))

    def test_keeps_gray(self) -> None:
        gray = RGB[..., 1]
        assert to_gray(gray) is gray
