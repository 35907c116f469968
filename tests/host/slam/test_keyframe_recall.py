"""Recalling keyframes: what the tracker gets, and what it gains."""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_map import png
from small_scene import HEIGHT, TRACK, WIDTH
from wall_map import POINTS, at, seen_from

from jaxslam.config.schema import Config
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import between, to_local
from jaxslam.mapping.local_mapping import recalled_id
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import Tracked
from jaxslam.slam.keyframe_recall import recall
from jaxslam.slam.slam import Slam


class TestRecall:
    def test_points(self) -> None:
        """As the map has them, in the keyframe's axes; those that were followed by flow first."""
        made = seen_from([at(), at(x=0.3)], [POINTS, POINTS])
        keyframe = recall(made, 1, 120)
        assert keyframe.keyframe == 1
        np.testing.assert_array_equal(keyframe.image, cv2.imdecode(np.frombuffer(png(1), np.uint8), 0))
        ids = -1 - keyframe.id[:POINTS]
        np.testing.assert_array_equal(recalled_id(ids), keyframe.id[:POINTS])
        np.testing.assert_array_equal(ids, [*range(1, POINTS, 2), *range(0, POINTS, 2)])
        np.testing.assert_allclose(
            keyframe.X_cam[:, :POINTS], to_local(at(x=0.3), made.points.X_world[:, ids]), atol=1e-6
        )
        mine = made.sightings.keyframe == 1
        np.testing.assert_array_equal(keyframe.seen_uv[:, :POINTS], made.sightings.seen_uv[:, mine][:, ids])
        np.testing.assert_array_equal(keyframe.weight[:POINTS], made.sightings.weight[mine][ids])
        assert not keyframe.weight[POINTS:].any()

    def test_no_more_than_there_is_room_for(self) -> None:
        keyframe = recall(seen_from([at()], [POINTS]), 0, 30)
        assert keyframe.seen_uv.shape == (2, 30)
        np.testing.assert_array_equal(-1 - keyframe.id, range(1, 61, 2))

    def test_damaged_image(self) -> None:
        made = seen_from([at()], [POINTS])
        damaged = made._replace(keyframes=(made.keyframes[0]._replace(image_png=b"no picture"),))
        with pytest.raises(RuntimeError, match="image of keyframe 0 cannot be decoded"):
            recall(damaged, 0, 30)


OUT = 72
SMALL_RING = replace(TRACK, num_keyframes=2, num_sources=2, points_per_source=128)


@functools.cache
def _there_and_back() -> tuple[list[Frame], np.ndarray]:
    """A path of 54 degrees of the room and back; and the true poses, the first as the world."""
    source = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=OUT, people=0, path="loop", fps=15))
    order = [*range(OUT), *range(OUT - 2, -1, -1)]
    images = [source[index] for index in range(OUT)]
    frames = [
        Frame(number * 66_666_666, images[index].image, images[index].depth_m) for number, index in enumerate(order)
    ]
    truth = source.T_world_cam
    return frames, between(truth[:1], truth[np.array(order)])


class TestTracking:
    def test_finds_their_points_again(self) -> None:
        """Back where the ring of keyframes has moved on from, the tracker finds more, and is no less right."""
        frames, truth = _there_and_back()
        late = slice(len(frames) - 40, len(frames))
        looked_up, errors = {}, {}
        for num_recalled in (0, 4):
            with Slam(_camera(), Config(track=replace(SMALL_RING, num_recalled=num_recalled))) as slam:
                results: list[Tracked] = [slam.track(frame) for frame in frames]
            poses = np.array([result.T_world_cam for result in results])
            looked_up[num_recalled] = np.mean([result.num_looked_up for result in results[late]])
            errors[num_recalled] = np.sqrt(np.square(poses[late, 4:] - truth[late, 4:]).sum(axis=1).mean())
        print(f"points found again {looked_up}, errors {errors}")
        assert looked_up[4] > 1.1 * looked_up[0]
        assert errors[4] < 1.1 * errors[0]


def _camera() -> Camera:
    return SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=1, people=0, path="loop", fps=15)).camera
