"""From points that move to pixels: only near them, only as far away as they are."""

import numpy as np

from jaxslam.dynamics.cue import CueResult
from jaxslam.dynamics.point_mask import mask_around, moving_points


def verdict(weight: list[float], known: list[bool]) -> CueResult:
    return CueResult(np.array(weight), np.zeros(len(weight)), np.array(known))  # pyright: ignore[reportArgumentType]


class TestMovingPoints:
    def test_needs_a_cue_that_knows(self) -> None:
        said = [verdict([0.0, 0.0, 0.6, 1.0], [True, False, True, True]), verdict([1.0, 1, 0.6, 1], [False] * 4)]
        assert moving_points(said).tolist() == [True, False, True, False]

    def test_no_cue(self) -> None:
        assert not moving_points(()).any()


def masked(uv: np.ndarray, depth: np.ndarray, reach_px: int) -> np.ndarray:
    mask = np.zeros(depth.shape, bool)
    mask_around(mask, uv, depth, reach_px)
    return mask


class TestMaskAround:
    depth = np.full((40, 60), 3.0)
    depth[10:30, 20:40] = 1.0
    depth[18, 25] = 0

    def test_stays_on_the_surface(self) -> None:
        mask = masked(np.array([[21.2], [20.0]]), self.depth, 4)
        expected = np.zeros_like(mask)
        expected[16:25, 20:26] = True
        assert (mask == expected).all()

    def test_without_depth_there_is_no_surface(self) -> None:
        mask = masked(np.array([[25.0], [18.0]]), self.depth, 2)
        assert mask.sum() == 25

    def test_at_the_border_and_outside(self) -> None:
        uv = np.array([[0.0, 59.0, -3.0, 70.0, np.nan], [0.0, 39.0, 5.0, 5.0, 5.0]])
        mask = masked(uv, self.depth, 3)
        assert mask.sum() == 2 * 16
        assert mask[:4, :4].all()
        assert mask[36:, 56:].all()

    def test_keeps_what_is_masked(self) -> None:
        mask = np.zeros(self.depth.shape, bool)
        mask[0, 0] = True
        mask_around(mask, np.array([[25.0], [18.0]]), self.depth, 2)
        assert mask[0, 0]
        assert mask.sum() == 26

    def test_no_points(self) -> None:
        assert not masked(np.zeros((2, 0)), self.depth, 3).any()

    def test_nan_is_missing(self):
        uv, missing = np.array([[20.0], [15.0]]), self.depth.copy()
        missing[10:20, 15:25] = 0
        np.testing.assert_array_equal(masked(uv, np.where(missing == 0, np.nan, missing), 4), masked(uv, missing, 4))
