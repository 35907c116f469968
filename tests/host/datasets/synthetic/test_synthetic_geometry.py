"""The synthetic recording against its own ground truth: depth, masks, motions and colors agree to the digit."""

import dataclasses

import cv2
import numpy as np
import pytest

from jaxslam.datasets.synthetic import (
    PERFECT_SENSOR,
    SyntheticConfig,
    SyntheticDataset,
    SyntheticFrame,
)
from jaxslam.datasets.synthetic.homogeneous import inverse, matrix_from_pose

SMALL = SyntheticConfig(width=160, height=120, frames=60, people=0, sensor=PERFECT_SENSOR)


def dataset_with(**changes: object) -> SyntheticDataset:
    return SyntheticDataset(dataclasses.replace(SMALL, **changes))


def points_in_camera(dataset: SyntheticDataset, frame: SyntheticFrame) -> np.ndarray:
    """`(3, pixels)` float64 points of all pixels."""
    v, u = np.mgrid[: dataset.height, : dataset.width]
    rays = np.stack([(u - dataset.cx) / dataset.fx, (v - dataset.cy) / dataset.fy, np.ones(u.shape)])
    return (rays * frame.exact_depth_m).reshape(3, -1)


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return matrix[:3, :3] @ points + matrix[:3, 3:]


def points_in_world(dataset: SyntheticDataset, frame: SyntheticFrame) -> np.ndarray:
    return moved(matrix_from_pose(frame.T_world_cam), points_in_camera(dataset, frame))


def seen_by(
    dataset: SyntheticDataset, world: np.ndarray, frame: SyntheticFrame
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points in the world appear in a frame: pixels `(2, n)`, depth `(n,)`, and whether inside the image."""
    x, y, z = moved(inverse(matrix_from_pose(frame.T_world_cam)), world)
    pixels = np.stack([dataset.fx * x / z + dataset.cx, dataset.fy * y / z + dataset.cy])
    low, high = np.array([[1.0], [1.0]]), np.array([[dataset.width - 2.0], [dataset.height - 2.0]])
    return pixels, z, (z > 0.1) & np.all((pixels >= low) & (pixels <= high), axis=0)


def sampled(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear samples in float64; OpenCV's own place pixels in steps of 1/32."""
    u, v = np.floor(pixels).astype(int)
    a, b = pixels[0] - u, pixels[1] - v
    image = image.astype(np.float64)
    a, b = (a[:, None], b[:, None]) if image.ndim == 3 else (a, b)
    near = image[v, u] * (1 - a) + image[v, u + 1] * a
    return near * (1 - b) + (image[v + 1, u] * (1 - a) + image[v + 1, u + 1] * a) * b


def smooth_depth(frame: SyntheticFrame) -> np.ndarray:
    """Whether the 4 x 4 pixels around lie on one plane: inverse depth is linear in the pixels of a plane."""
    bend = np.abs(cv2.Laplacian(1.0 / frame.exact_depth_m.astype(np.float64), cv2.CV_64F))
    return cv2.dilate(bend, np.ones((5, 5))) < 1e-4


class TestExactDepth:
    def test_walls_and_floor_are_where_they_are(self):
        dataset = dataset_with()
        x, _, z = points_in_world(dataset, dataset.render(0))
        for distance in (z, 2.7 - x):
            assert distance.min() > -1e-5
            assert np.count_nonzero(distance < 1e-5) > 2000

    @pytest.mark.parametrize("path", ["xyz", "rpy", "loop"])
    def test_static_points_agree_between_frames(self, path):
        dataset = dataset_with(path=path)
        first, second = dataset.render(5), dataset.render(20)
        world = points_in_world(dataset, first)
        pixels, depth, inside = seen_by(dataset, world, second)
        inside &= smooth_depth(first).ravel()
        pixels, depth = pixels[:, inside], depth[inside]
        flat = sampled(smooth_depth(second).astype(float), pixels) == 1.0
        other = 1.0 / sampled(1.0 / second.exact_depth_m.astype(np.float64), pixels[:, flat])
        error = np.abs(other - depth[flat])
        unoccluded = depth[flat] < other + 0.03
        assert np.count_nonzero(unoccluded) > 4000
        assert np.mean(error[unoccluded] < 1e-3) > 0.99
        assert np.median(error[unoccluded]) < 2e-5

    @pytest.mark.slow
    def test_any_size_and_camera_sees_the_same(self):
        """A crop of a shifted, wider image, whose tiles lie differently, has the same depth."""
        dataset = dataset_with(people=2)
        wide = dataset_with(people=2, width=203, height=141, fx=dataset.fx, fy=dataset.fy, cx=100.5, cy=70.5)
        one, other = dataset.render(3), wide.render(3)
        crop = np.s_[11 : 11 + 120, 21 : 21 + 160]
        np.testing.assert_allclose(other.exact_depth_m[crop], one.exact_depth_m, atol=1e-5)
        np.testing.assert_array_equal(other.instance_mask[crop], one.instance_mask)
        assert np.abs(other.rgb[crop].astype(int) - one.rgb).mean() < 0.5


class TestMasks:
    def test_true_exactly_where_actors_hide_the_room(self):
        empty, crowded = dataset_with(), dataset_with(people=3, boxes=1)
        for index in (0, 25, 50):
            room, frame = empty.render(index), crowded.render(index)
            nearer = frame.exact_depth_m < room.exact_depth_m
            np.testing.assert_array_equal(frame.instance_mask > 0, nearer)
            static = ~nearer
            np.testing.assert_array_equal(frame.exact_depth_m[static], room.exact_depth_m[static])
            assert 0.02 < nearer.mean() < 0.8

    def test_number_is_that_of_the_actor_at_that_place(self):
        dataset = dataset_with(people=3, boxes=1)
        met = set()
        for index in range(0, 60, 10):
            frame = dataset.render(index)
            world, mask = points_in_world(dataset, frame), frame.instance_mask.ravel()
            for number in np.unique(mask[mask > 0]):
                x, y, z = world[:, mask == number]
                place = frame.T_world_actor[number - 1, 4:]
                assert np.hypot(x - place[0], y - place[1]).max() < 0.75
                assert z.min() > -0.01
                assert z.max() < 1.95
                met.add(number)
        assert met == {1, 2, 3, 4}


class TestMovers:
    def test_points_on_a_box_are_carried_by_its_pose(self):
        dataset = dataset_with(boxes=1, path="static")
        frames = [dataset.render(index) for index in range(0, 60, 6)]
        visible = [np.count_nonzero(frame.instance_mask == 1) for frame in frames]
        start = int(np.argmax(np.minimum(visible[:-1], visible[1:])))
        first, second = frames[start], frames[start + 1]
        assert min(visible[start], visible[start + 1]) > 300
        box_to_box = matrix_from_pose(second.T_world_actor[0]) @ inverse(matrix_from_pose(first.T_world_actor[0]))
        assert np.linalg.norm(second.T_world_actor[0, 4:] - first.T_world_actor[0, 4:]) > 0.02
        on_box = (first.instance_mask == 1).ravel() & smooth_depth(first).ravel()
        world = points_in_world(dataset, first)[:, on_box]
        pixels, depth, inside = seen_by(dataset, moved(box_to_box, world), second)
        pixels, depth = pixels[:, inside], depth[inside]
        flat = sampled((smooth_depth(second) & (second.instance_mask == 1)).astype(float), pixels) == 1.0
        other = 1.0 / sampled(1.0 / second.exact_depth_m.astype(np.float64), pixels[:, flat])
        assert np.count_nonzero(flat) > 100
        assert np.abs(other - depth[flat]).max() < 1e-3
        still_pixels, still_depth, still = seen_by(dataset, world, second)
        still_other = 1.0 / sampled(1.0 / second.exact_depth_m.astype(np.float64), still_pixels[:, still])
        assert np.median(np.abs(still_other - still_depth[still])) > 5e-3

    def test_points_lie_on_the_surface_of_the_box(self):
        dataset = dataset_with(boxes=1, path="static")
        half = dataset.actors[0].solids[0].size
        checked = 0
        for index in range(0, 60, 6):
            frame = dataset.render(index)
            world = points_in_world(dataset, frame)[:, (frame.instance_mask == 1).ravel()]
            local = moved(inverse(matrix_from_pose(frame.T_world_actor[0])), world)
            distance = np.max(np.abs(local) - half[:, None], axis=0)
            checked += distance.size
            np.testing.assert_allclose(distance, 0.0, atol=1e-4)
        assert checked > 1000


class TestColor:
    @pytest.mark.parametrize("path", ["xyz", "halfsphere", "rpy"])
    def test_static_points_keep_their_color(self, path):
        dataset = dataset_with(path=path, width=320, height=240)
        first, second = dataset.render(5), dataset.render(12)
        pixels, depth, inside = seen_by(dataset, points_in_world(dataset, first), second)
        inside &= smooth_depth(first).ravel()
        pixels, depth = pixels[:, inside], depth[inside]
        visible = np.abs(1.0 / sampled(1.0 / second.exact_depth_m.astype(np.float64), pixels) - depth) < 2e-3
        assert np.count_nonzero(visible) > 0.3 * depth.size
        color = first.rgb.reshape(-1, 3)[inside][visible].astype(np.float64)
        error = np.abs(sampled(second.rgb, pixels[:, visible]) - color).mean(axis=1)
        assert np.median(error) < 2.0
        assert np.mean(error < 10.0) > 0.95
        shuffled = np.random.default_rng(0).permutation(color)
        assert np.median(np.abs(shuffled - color).mean(axis=1)) > 8.0 * np.median(error)

    def test_texture_at_all_scales_without_shimmer(self):
        """Detail is there in the large picture, and a small one looks like the large one averaged."""
        large = dataset_with(width=320, height=240).render(0).rgb
        small = dataset_with().render(0).rgb
        averaged = cv2.resize(large, (160, 120), interpolation=cv2.INTER_AREA)
        assert np.median(np.abs(averaged.astype(int) - small)) <= 5.0
        gray = cv2.cvtColor(large, cv2.COLOR_RGB2GRAY).astype(np.float32)
        for _ in range(3):
            detail = gray - cv2.GaussianBlur(gray, (0, 0), 1.5)
            assert detail.std() > 4.0
            gray = cv2.pyrDown(gray)
