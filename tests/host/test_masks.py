"""Masks from boxes, and masks carried on: on made depth images, and on the room with people, whose masks are known."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.image import Pyramid, build_pyramid

from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.frame import to_grey
from jaxslam.masks.box_mask import add_box, dilated, largest_parts, mask_of_detections, object_depth
from jaxslam.masks.propagation import CAPACITY, Followed, follow, predicted_mask
from jaxslam.masks.sampling import CELL_PX, sample_mask
from jaxslam.masks.stillness import without_still_parts
from jaxslam.pose import IDENTITY
from jaxslam.semantics import Detections, no_detections

HEIGHT, WIDTH = 240, 320
FIRST, LAST = 10, 14
WHOLE = WIDTH // CELL_PX * CELL_PX
"""Columns of whole cells."""


@functools.cache
def room() -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=30, people=2))


@functools.cache
def seen(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey image, depth, and true mask of people."""
    frame = room().render(index)
    return to_grey(frame.rgb), frame.depth_m, frame.instance_mask > 0


def detections(boxes: list[list[float]]) -> Detections:
    return no_detections()._replace(
        boxes=np.array(boxes, np.float32).reshape(-1, 4),
        scores=np.ones(len(boxes), np.float32),
        labels=("person",) * len(boxes),
    )


def pyramid(grey: np.ndarray) -> Pyramid:
    return build_pyramid(jnp.asarray(grey))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / max(np.count_nonzero(a | b), 1)


class TestBoxMask:
    DEPTH = np.full((100, 120), 3.0, np.float32)
    DEPTH[20:80, 40:70] = 1.5

    def test_object_before_a_wall(self) -> None:
        mask = mask_of_detections(detections([[35, 15, 75, 85]]), self.DEPTH, dilate_px=0)
        np.testing.assert_array_equal(mask, self.DEPTH < 2)

    def test_several_and_what_reaches_past_the_image(self) -> None:
        depth = self.DEPTH.copy()
        depth[50:, 100:] = 1.0
        mask = mask_of_detections(detections([[35, 15, 75, 85], [95, 45, 150, 130]]), depth, dilate_px=0)
        np.testing.assert_array_equal(mask, depth < 2)

    def test_as_far_away_but_apart(self) -> None:
        """A small thing in the same box and depth, not attached."""
        depth = self.DEPTH.copy()
        depth[20:26, 30:34] = 1.5
        mask = mask_of_detections(detections([[28, 15, 75, 85]]), depth, dilate_px=0)
        np.testing.assert_array_equal(mask, self.DEPTH < 2)

    @pytest.mark.parametrize(
        "box", [[50, 30, 51, 31], [200, 10, 220, 50], [70, 60, 40, 20], [np.nan, 0, 10, 10], [-50, -50, -10, -10]]
    )
    def test_boxes_of_nothing(self, box: list[float]) -> None:
        assert not mask_of_detections(detections([box]), self.DEPTH, dilate_px=0).any()

    @pytest.mark.parametrize("value", [0.0, np.nan])
    def test_without_depth(self, value: float) -> None:
        depth = np.full((60, 60), value, np.float32)
        assert object_depth(depth) is None
        assert not mask_of_detections(detections([[10, 10, 50, 50]]), depth, dilate_px=2).any()

    def test_networks_own_masks_come_first(self) -> None:
        own = np.zeros((1, 100, 120), bool)
        own[0, :10] = True
        found = detections([[35, 15, 75, 85]])._replace(masks=own)
        np.testing.assert_array_equal(mask_of_detections(found, self.DEPTH, dilate_px=0), own[0])
        labelled = no_detections()._replace(class_mask=own[0])
        np.testing.assert_array_equal(mask_of_detections(labelled, self.DEPTH, dilate_px=0), own[0])

    def test_people_of_the_room(self) -> None:
        _, depth, truth = seen(FIRST)
        boxes = []
        instance = room().render(FIRST).instance_mask
        for number in np.unique(instance[instance > 0]):
            rows, columns = (np.flatnonzero((instance == number).any(axis=axis)) for axis in (1, 0))
            boxes.append([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
        assert boxes
        found = mask_of_detections(detections(boxes), depth, dilate_px=0)
        print(f"overlap with the truth {overlap(found, truth):.3f}")
        assert overlap(found, truth) > 0.8

    def test_dilated(self) -> None:
        mask = np.zeros((9, 9), bool)
        mask[4, 4] = True
        assert np.count_nonzero(dilated(mask, 2)) == 25
        np.testing.assert_array_equal(dilated(mask, 0), mask)

    def test_largest_parts_of_nothing(self) -> None:
        assert not largest_parts(np.zeros((4, 4), bool)).any()

    @given(st.lists(st.floats(-200, 400), min_size=4, max_size=4))
    @settings(max_examples=50, deadline=None)
    def test_stays_in_its_box(self, box: list[float]) -> None:
        mask = np.zeros(self.DEPTH.shape, bool)
        add_box(mask, self.DEPTH, box)
        rows, columns = np.nonzero(mask)
        assert ((columns >= box[0] - 1) & (columns <= box[2]) & (rows >= box[1] - 1) & (rows <= box[3])).all()


class TestSampleMask:
    def test_one_in_every_cell(self) -> None:
        grey, _, truth = seen(FIRST)
        points = sample_mask(truth, grey, CAPACITY, 0)
        column, row = points.astype(int)
        assert truth[row, column].all()
        cells = row // CELL_PX * 1000 + column // CELL_PX
        rows, columns = np.nonzero(truth[: HEIGHT // CELL_PX * CELL_PX, : WIDTH // CELL_PX * CELL_PX])
        assert len(cells) == len(np.unique(cells)) == len(np.unique(rows // CELL_PX * 1000 + columns // CELL_PX))

    def test_capacity_and_seed(self) -> None:
        flat, everywhere = np.zeros((HEIGHT, WIDTH), np.uint8), np.ones((HEIGHT, WIDTH), bool)
        assert sample_mask(everywhere, flat, 20, 0).shape == (2, 20)
        same, again, other = (sample_mask(everywhere, flat, CAPACITY, seed) for seed in (1, 1, 2))
        np.testing.assert_array_equal(same, again)
        assert (same != other).any()

    def test_nothing(self) -> None:
        grey = seen(FIRST)[0]
        assert sample_mask(np.zeros(grey.shape, bool), grey, 20, 0).shape == (2, 0)


def carried(first: int, last: int) -> tuple[np.ndarray, Followed]:
    grey, _, mask = seen(first)
    pyramids = [pyramid(seen(index)[0]) for index in range(first, last + 1)]
    followed = follow(pyramids, sample_mask(mask, grey, CAPACITY, 0))
    return predicted_mask(mask, followed, seen(last)[1]), followed


class TestPropagation:
    def test_people_are_followed(self) -> None:
        """Better than the mask left where it was."""
        new, _ = carried(FIRST, LAST)
        truth, old = seen(LAST)[2], seen(FIRST)[2]
        print(f"overlap {overlap(new, truth):.3f}, left where it was {overlap(old, truth):.3f}")
        assert overlap(new, truth) > 0.7
        assert overlap(new, truth) > overlap(old, truth)

    def test_nothing_to_follow(self) -> None:
        grey, depth, _ = seen(FIRST)
        nothing = np.zeros((2, 0), np.float32)
        followed = follow([pyramid(grey)] * 2, nothing)
        assert not followed.ok.any()
        assert not predicted_mask(np.zeros(grey.shape, bool), followed, depth).any()

    @pytest.mark.parametrize("value", [0.0, np.nan])
    def test_without_depth(self, value: float) -> None:
        mask, depth = seen(FIRST)[2], np.full((HEIGHT, WIDTH), value, np.float32)
        assert not predicted_mask(mask, carried(FIRST, LAST)[1], depth).any()

    def test_out_of_the_image(self) -> None:
        mask, depth = seen(FIRST)[2], seen(FIRST)[1]
        followed = carried(FIRST, LAST)[1]
        gone = followed._replace(now=followed.now + np.float32(1000))
        assert not predicted_mask(mask, gone, depth).any()


class TestStillness:
    @staticmethod
    def grid() -> np.ndarray:
        v, u = np.mgrid[CELL_PX // 2 : HEIGHT : CELL_PX, CELL_PX // 2 : WIDTH : CELL_PX]
        return np.stack([u.ravel(), v.ravel()]).astype(np.float32)

    def test_what_stands_still_leaves(self) -> None:
        """The left half moves by 5 pixels under a camera at rest."""
        uv = self.grid()
        moving = uv[0] < WIDTH // 2
        followed = Followed(uv - np.where(moving, 5, 0).astype(np.float32)[None], uv, np.ones(uv.shape[1], bool))
        mask, depth = np.ones((HEIGHT, WIDTH), bool), np.full((HEIGHT, WIDTH), 2.0, np.float32)
        left = without_still_parts(mask, followed, depth, IDENTITY, IDENTITY, room().camera)
        assert left[:, : WIDTH // 2 - CELL_PX].all()
        assert not left[:, WIDTH // 2 + CELL_PX : WHOLE].any()

    def test_camera_moves(self) -> None:
        """What moves as the camera alone would have it stands still."""
        camera, uv, z = room().camera, self.grid(), 2.0
        shift_px = 10.0
        now = np.array([1.0, 0, 0, 0, shift_px * z / camera.fx, 0, 0])
        followed = Followed(uv + np.array([[shift_px], [0]], np.float32), uv, np.ones(uv.shape[1], bool))
        mask, depth = np.ones((HEIGHT, WIDTH), bool), np.full((HEIGHT, WIDTH), z, np.float32)
        assert not without_still_parts(mask, followed, depth, IDENTITY, now, camera)[:, :WHOLE].any()
        assert without_still_parts(mask, followed, depth, IDENTITY, IDENTITY, camera).all()

    def test_nothing_known(self) -> None:
        uv = self.grid()
        followed = Followed(uv, uv, np.ones(uv.shape[1], bool))
        mask, depth = np.ones((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), np.float32)
        assert without_still_parts(mask, followed, depth, IDENTITY, IDENTITY, room().camera).all()
