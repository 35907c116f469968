"""Masks from boxes, and masks carried on: on made depth images, and on the room with people, whose masks are known."""

import functools

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.image.pyramid import Pyramid, build_pyramid
from quick_compile import quick_compile

from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.dynamics.object_motion import INERT
from jaxslam.masks.box_to_mask import (
    add_box,
    dilated,
    instance_labels,
    largest_parts,
    mask_of_detections,
    object_depth,
)
from jaxslam.masks.point_sampling import CELL_PX, sample_mask
from jaxslam.masks.propagation import (
    CAPACITY,
    PYRAMID_LEVELS,
    MaskFlow,
    TrackedMask,
    as_objects,
    follow,
    make_origin,
    predicted_mask,
)
from jaxslam.semantics import Detections, no_detections
from jaxslam.sensors.frame import to_gray

HEIGHT, WIDTH, FOCAL_PX = 240, 320, 262.5
FARTHEST_M = 6.0
FIRST, LAST = 10, 14


@functools.cache
def room() -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=30, people=2))


@functools.cache
def seen(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gray image, depth, and true mask of people."""
    frame = room().render(index)
    return to_gray(frame.rgb), frame.depth_m, frame.instance_mask > 0


def detections(boxes: list[list[float]]) -> Detections:
    return no_detections()._replace(
        boxes=np.array(boxes, np.float32).reshape(-1, 4),
        scores=np.ones(len(boxes), np.float32),
        labels=("person",) * len(boxes),
    )


_build = quick_compile(functools.partial(build_pyramid, num_levels=PYRAMID_LEVELS))


def pyramid(gray: np.ndarray) -> Pyramid:
    return _build(jnp.asarray(gray))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / max(np.count_nonzero(a | b), 1)


class TestInstanceLabels:
    """Which detection each pixel is of, and which do not move by themselves."""

    BLIND = np.zeros((100, 120), np.float32)
    FOUND = detections([[20, 20, 60, 90], [40, 30, 100, 80], [5, 5, 15, 15]])._replace(
        labels=("person", "chair", "arm")
    )

    def test_a_person_before_a_chair(self):
        labels = instance_labels(self.FOUND, self.BLIND, FOCAL_PX)
        assert (labels[30:80, 60:100] == INERT + 2).all()
        assert (labels[20:90, 20:60] == 1).all()
        assert (labels[5:15, 5:15] == 3).all()
        np.testing.assert_array_equal(labels > 0, mask_of_detections(self.FOUND, self.BLIND, FOCAL_PX, dilate_px=0))

    def test_masks_of_the_detector(self):
        masks = np.zeros((3, *self.BLIND.shape), bool)
        masks[0, 50:60, 50:60] = masks[1, 55:70, 50:60] = True
        masks[2, 0, 0] = True
        labels = instance_labels(self.FOUND._replace(masks=masks), self.BLIND, FOCAL_PX)
        assert np.bincount(labels.ravel())[[1, 3, INERT + 2]].tolist() == [100, 1, 100]

    def test_a_class_map_does_not_tell_objects(self):
        found = no_detections()._replace(class_mask=np.ones(self.BLIND.shape, bool))
        assert not instance_labels(found, self.BLIND, FOCAL_PX).any()

    def test_more_objects_than_numbers(self):
        many = detections([[2, 2, 50, 50]] * 300)
        assert set(np.unique(instance_labels(many, self.BLIND, FOCAL_PX))) == {0, 1}


class TestWithoutDepth:
    BLIND = np.zeros((100, 120), np.float32)

    @pytest.mark.parametrize("missing", [0.0, np.nan])
    def test_a_box_is_masked_as_a_whole(self, missing: float):
        depth = self.BLIND + np.float32(missing)
        mask = mask_of_detections(detections([[35, 15, 75, 85]]), depth, FOCAL_PX, dilate_px=0)
        assert mask[15:85, 35:75].all()
        assert mask.sum() == 70 * 40

    def test_a_mask_is_moved_as_it_is(self):
        """Neither cut nor dilated, however many frames go by."""
        gray, _, mask = seen(FIRST)
        for index in range(FIRST + 1, LAST + 1):
            now = seen(index)[0]
            origin = make_origin(mask, gray, 0)
            _, followed = follow(origin, [pyramid(gray)], now, np.ones((HEIGHT, WIDTH), np.float32))
            mask, gray = predicted_mask(origin, followed, None, FARTHEST_M), now
        print(f"overlap after {LAST - FIRST} frames: {overlap(mask, seen(LAST)[2]):.2f}")
        assert overlap(mask, seen(LAST)[2]) > 0.75


class TestBoxMask:
    DEPTH = np.full((100, 120), 3.0, np.float32)
    DEPTH[20:80, 40:70] = 1.5

    def test_object_before_a_wall(self) -> None:
        mask = mask_of_detections(detections([[35, 15, 75, 85]]), self.DEPTH, FOCAL_PX, dilate_px=0)
        np.testing.assert_array_equal(mask, self.DEPTH < 2)

    def test_several_and_what_reaches_past_the_image(self) -> None:
        depth = self.DEPTH.copy()
        depth[50:, 100:] = 1.0
        mask = mask_of_detections(detections([[35, 15, 75, 85], [95, 45, 150, 130]]), depth, FOCAL_PX, dilate_px=0)
        np.testing.assert_array_equal(mask, depth < 2)

    def test_as_far_away_but_apart(self) -> None:
        """A small thing in the same box and depth, not attached."""
        depth = self.DEPTH.copy()
        depth[20:26, 30:34] = 1.5
        mask = mask_of_detections(detections([[28, 15, 75, 85]]), depth, FOCAL_PX, dilate_px=0)
        np.testing.assert_array_equal(mask, self.DEPTH < 2)

    @pytest.mark.parametrize(
        "box", [[50, 30, 51, 31], [200, 10, 220, 50], [70, 60, 40, 20], [np.nan, 0, 10, 10], [-50, -50, -10, -10]]
    )
    def test_boxes_of_nothing(self, box: list[float]) -> None:
        assert not mask_of_detections(detections([box]), self.DEPTH, FOCAL_PX, dilate_px=0).any()

    @pytest.mark.parametrize("value", [0.0, np.nan])
    def test_without_depth(self, value: float) -> None:
        depth = np.full((60, 60), value, np.float32)
        assert object_depth(depth) is None
        depth[:5, :5] = 1  # the frame has depth, and the box has none
        assert not mask_of_detections(detections([[10, 10, 50, 50]]), depth, FOCAL_PX, dilate_px=2).any()

    @pytest.mark.parametrize("scale", [0.06, 1.0, 12.0, 100.0])
    def test_at_any_distance(self, scale: float) -> None:
        """A car 30 m down the road and a hand before the lens are masked as a person in a room is."""
        found = mask_of_detections(detections([[35, 15, 75, 85]]), scale * self.DEPTH, FOCAL_PX, dilate_px=0)
        assert object_depth(scale * self.DEPTH[15:85, 35:75]) == pytest.approx(1.5 * scale, rel=0.03)
        assert found[20:80, 40:70].all()

    def test_networks_own_masks_come_first(self) -> None:
        own = np.zeros((1, 100, 120), bool)
        own[0, :10] = True
        found = detections([[35, 15, 75, 85]])._replace(masks=own)
        np.testing.assert_array_equal(mask_of_detections(found, self.DEPTH, FOCAL_PX, dilate_px=0), own[0])
        labeled = no_detections()._replace(class_mask=own[0])
        np.testing.assert_array_equal(mask_of_detections(labeled, self.DEPTH, FOCAL_PX, dilate_px=0), own[0])

    def test_people_of_the_room(self) -> None:
        _, depth, truth = seen(FIRST)
        boxes = []
        instance = room().render(FIRST).instance_mask
        for number in np.unique(instance[instance > 0]):
            rows, columns = (np.flatnonzero((instance == number).any(axis=axis)) for axis in (1, 0))
            boxes.append([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
        assert boxes
        found = mask_of_detections(detections(boxes), depth, FOCAL_PX, dilate_px=0)
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
        add_box(mask, self.DEPTH, box, FOCAL_PX)
        rows, columns = np.nonzero(mask)
        assert ((columns >= box[0] - 1) & (columns <= box[2]) & (rows >= box[1] - 1) & (rows <= box[3])).all()


class TestSampleMask:
    def test_one_in_every_cell(self) -> None:
        gray, _, truth = seen(FIRST)
        points, spacing = sample_mask(truth, gray, WIDTH * HEIGHT, 0)
        assert spacing == 1
        column, row = points.astype(int)
        assert truth[row, column].all()
        cells = row // CELL_PX * 1000 + column // CELL_PX
        rows, columns = np.nonzero(truth[: HEIGHT // CELL_PX * CELL_PX, : WIDTH // CELL_PX * CELL_PX])
        assert len(cells) == len(np.unique(cells)) == len(np.unique(rows // CELL_PX * 1000 + columns // CELL_PX))

    def test_capacity_and_seed(self) -> None:
        flat, everywhere = np.zeros((HEIGHT, WIDTH), np.uint8), np.ones((HEIGHT, WIDTH), bool)
        assert sample_mask(everywhere, flat, 20, 0).uv.shape == (2, 20)
        same, again, other = (sample_mask(everywhere, flat, CAPACITY, seed).uv for seed in (1, 1, 2))
        np.testing.assert_array_equal(same, again)
        assert (same != other).any()

    def test_without_texture(self) -> None:
        """Random pixels, of the mask only."""
        mask = np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.05
        column, row = sample_mask(mask, np.zeros(mask.shape, np.uint8), WIDTH * HEIGHT, 0).uv.astype(int)
        assert mask[row, column].all()
        assert 3 < np.mean(row % CELL_PX) < 4
        assert 3 < np.mean(column % CELL_PX) < 4

    def test_best_corners_of_the_whole_image(self) -> None:
        """Also at the edge of the mask, and of the image, of which only a part is looked at."""
        gray = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
        score = cv2.cornerMinEigenVal(gray, 5)
        for rows, columns in ((slice(0, 40), slice(0, 100)), (slice(97, 152), slice(203, WIDTH)), (slice(0, 240),) * 2):
            mask = np.zeros(gray.shape, bool)
            mask[rows, columns] = True
            column, row = sample_mask(mask, gray, WIDTH * HEIGHT, 0).uv.astype(int)
            masked = np.where(mask, score, -1)[:, : WIDTH // CELL_PX * CELL_PX]
            best = masked.reshape(HEIGHT // CELL_PX, CELL_PX, -1, CELL_PX).max(axis=(1, 3)).ravel()
            np.testing.assert_array_equal(score[row, column], best[best >= 0])

    def test_fast_corners_of_the_whole_image(self) -> None:
        """The strongest one of each cell that has any, and a random pixel of other cells."""
        gray = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
        gray[:, : WIDTH // 2] = 90
        gray[40:60, 50:90] = 200
        score = np.zeros(gray.shape)
        for corner in cv2.FastFeatureDetector.create(20).detect(gray):
            column, row = map(int, corner.pt)
            score[row, column] = corner.response
        for rows, columns in ((slice(33, 120), slice(43, 230)), (slice(0, 240),) * 2):
            mask = np.zeros(gray.shape, bool)
            mask[rows, columns] = True
            column, row = sample_mask(mask, gray, WIDTH * HEIGHT, 0, "fast").uv.astype(int)
            masked = np.where(mask, score, -1)[:, : WIDTH // CELL_PX * CELL_PX]
            best = masked.reshape(HEIGHT // CELL_PX, CELL_PX, -1, CELL_PX).max(axis=(1, 3)).ravel()
            assert mask[row, column].all()
            assert 4 < np.count_nonzero(best > 0) < np.count_nonzero(best >= 0)
            np.testing.assert_array_equal(score[row, column], best[best >= 0])

    def test_fewer_than_cells(self) -> None:
        """They are all over the mask, not only where the picture has most texture."""
        gray, everywhere = np.zeros((HEIGHT, WIDTH), np.uint8), np.ones((HEIGHT, WIDTH), bool)
        gray[:60, :80] = np.random.default_rng(0).integers(0, 256, (60, 80))
        column, row = sample_mask(everywhere, gray, 60, 0).uv
        num, _, _ = np.histogram2d(row, column, bins=[3, 4], range=[[0, HEIGHT], [0, WIDTH]])
        print(num)
        assert num.sum() == 60
        assert num.min() >= 2

    def test_spacing(self) -> None:
        mask, gray = np.zeros((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[: 10 * CELL_PX, : 10 * CELL_PX] = True
        assert [sample_mask(mask, gray, capacity, 0).spacing for capacity in (200, 100, 25)] == [1, 1, 2]

    def test_small_pieces_keep_their_points(self) -> None:
        """Somebody far away beside somebody near: the one has all he can have, the other gives way."""
        mask, gray = np.zeros((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), np.uint8)
        near, far = (slice(0, 26 * CELL_PX), slice(0, 16 * CELL_PX)), (slice(CELL_PX, 5 * CELL_PX), slice(200, 216))
        mask[near] = mask[far] = True
        (column, row), spacing = sample_mask(mask, gray, 72, 0)
        is_far = column >= 200
        assert (np.sum(is_far), np.sum(~is_far)) == (8, 64)
        assert spacing == pytest.approx(np.sqrt(26 * 16 / 64))
        assert np.ptp(row[~is_far]) > 20 * CELL_PX

    def test_more_pieces_than_points(self) -> None:
        mask, gray = np.zeros((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[::16, ::16] = True
        column, row = sample_mask(mask, gray, 50, 0).uv.astype(int)
        assert len(column) == 50
        assert mask[row, column].all()

    def test_nothing(self) -> None:
        gray = seen(FIRST)[0]
        assert sample_mask(np.zeros(gray.shape, bool), gray, 20, 0).uv.shape == (2, 0)


def carried(first: int, last: int) -> tuple[np.ndarray, TrackedMask, MaskFlow]:
    gray, _, mask = seen(first)
    origin = make_origin(mask, gray, 0)
    pyramids = [pyramid(seen(index)[0]) for index in range(first, last)]
    _, followed = follow(origin, pyramids, seen(last)[0], seen(last)[1])
    return predicted_mask(origin, followed, seen(last)[1], FARTHEST_M), origin, followed


def moved(mask: np.ndarray, shift_px: tuple[int, int], depth: np.ndarray) -> tuple[TrackedMask, MaskFlow]:
    """A mask, and its points, all moved by so much."""
    origin = make_origin(mask, np.zeros(mask.shape, np.uint8), 0)
    now = origin.uv + np.array(shift_px, np.float32)[:, None]
    return origin, as_objects(now, origin.ok, depth, origin.spacing)


def rectangle(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = True
    return mask


class TestPropagation:
    @pytest.mark.parametrize("shift_px", [(0, 0), (13, -6), (-90, 0), (140, 90), (30, -120)])
    def test_what_depth_shows(self, shift_px: tuple[int, int]) -> None:
        """An object before a wall, a little larger than its mask, also where it leaves the image."""
        u, v = shift_px
        mask, truth = rectangle(64, 64, 196, 176), rectangle(60 + u, 60 + v, 200 + u, 180 + v)
        depth = np.where(truth, 1.5, 3.0).astype(np.float32)
        np.testing.assert_array_equal(predicted_mask(*moved(mask, shift_px, depth), depth, FARTHEST_M), truth)

    def test_pieces_without_points_do_not_move(self) -> None:
        """Of two parts of a mask on one surface, points were followed of one only."""
        followed_part, other = rectangle(20, 60, 110, 180), rectangle(140, 60, 260, 180)
        depth = np.where(rectangle(20, 60, 260, 180), 1.5, 3.0).astype(np.float32)
        points, followed = moved(followed_part, (0, 0), depth)
        origin = make_origin(followed_part | other, np.zeros(depth.shape, np.uint8), 0)
        column, row = points.uv.astype(int) - origin.corner[:, None]
        origin = origin._replace(uv=points.uv, held=np.where(points.ok, origin.piece[row, column], 0))
        new = predicted_mask(origin, followed, depth, FARTHEST_M)
        assert (new & followed_part).sum() == followed_part.sum()
        assert not (new & other).any()

    def test_objects_with_their_own_motion(self) -> None:
        """Two parts of a mask at two depths, moving towards each other."""
        parts, depths, shifts = (rectangle(20, 60, 110, 180), rectangle(170, 60, 260, 180)), (1.5, 2.5), (20, -30)
        mask, depth, truth = parts[0] | parts[1], np.full((HEIGHT, WIDTH), 4.0, np.float32), np.zeros_like(parts[0])
        origin = make_origin(mask, np.zeros(mask.shape, np.uint8), 0)
        (column, row), now = origin.uv.astype(int), origin.uv.copy()
        for part, z, shift in zip(parts, depths, shifts, strict=True):
            now[0, part[row, column]] += shift
            depth[np.roll(part, shift, axis=1)] = z
            truth |= np.roll(part, shift, axis=1)
        followed = as_objects(now, origin.ok, depth, origin.spacing)
        np.testing.assert_array_equal(predicted_mask(origin, followed, depth, FARTHEST_M), truth)

    def test_points_far_apart(self) -> None:
        """One object fills an image of which every third cell has a point."""
        mask, depth = np.ones((HEIGHT, WIDTH), bool), np.full((HEIGHT, WIDTH), 2.0, np.float32)
        assert make_origin(mask, np.zeros(mask.shape, np.uint8), 0).spacing > 3
        assert predicted_mask(*moved(mask, (0, 0), depth), depth, FARTHEST_M).all()

    def test_piece_too_small_for_a_cluster(self) -> None:
        """Three cells high: it is followed nevertheless, and it alone."""
        near, far, beside = rectangle(10, 10, 170, 230), rectangle(250, 90, 257, 112), rectangle(230, 90, 250, 112)
        depth = np.where(near, 1.2, np.where(far, 3.5, np.where(beside, 4.2, 5.0))).astype(np.float32)
        np.testing.assert_array_equal(predicted_mask(*moved(near | far, (0, 0), depth), depth, FARTHEST_M), near | far)

    def test_far_beside_near(self) -> None:
        """Both are followed, though one has a twentieth of the other's pixels."""
        near, far = rectangle(10, 10, 170, 230), rectangle(250, 90, 274, 162)
        depth = np.where(near, 1.2, np.where(far, 3.5, 5.0)).astype(np.float32)
        np.testing.assert_array_equal(predicted_mask(*moved(near | far, (0, 0), depth), depth, FARTHEST_M), near | far)

    @pytest.mark.slow
    def test_people_are_followed(self) -> None:
        """Better than the mask left where it was."""
        new, _, _ = carried(FIRST, LAST)
        truth, old = seen(LAST)[2], seen(FIRST)[2]
        print(f"overlap {overlap(new, truth):.3f}, left where it was {overlap(old, truth):.3f}")
        assert overlap(new, truth) > 0.7
        assert overlap(new, truth) > overlap(old, truth)

    def test_nothing_to_follow(self) -> None:
        gray, depth, _ = seen(FIRST)
        origin = make_origin(np.zeros(gray.shape, bool), gray, 0)
        _, followed = follow(origin, [pyramid(gray)], gray, depth)
        assert (np.asarray(followed.label) == -1).all()
        assert not predicted_mask(origin, followed, depth, FARTHEST_M).any()

    @pytest.mark.parametrize("value", [0.0, np.nan])
    def test_without_depth(self, value: float) -> None:
        mask, depth = seen(FIRST)[2], np.full((HEIGHT, WIDTH), value, np.float32)
        assert not predicted_mask(*moved(mask, (0, 0), depth), depth, FARTHEST_M).any()

    def test_out_of_the_image(self) -> None:
        depth, mask = seen(FIRST)[1:]
        assert not predicted_mask(*moved(mask, (1000, 1000), depth), depth, FARTHEST_M).any()
