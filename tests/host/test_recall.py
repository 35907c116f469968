"""Recalling keyframes: which are worth it, what the tracker gets, and what it gains."""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_map import CAMERA, features, png, sightings
from small_scene import HEIGHT, TRACK, WIDTH

from jaxslam.camera import Camera
from jaxslam.config import Config
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.frame import Frame
from jaxslam.local_map import keyframes_in_view
from jaxslam.local_mapping import recalled_id
from jaxslam.map import NONE, Keyframe, Map, MapPoints, empty_map
from jaxslam.map_edit import with_keyframe, with_points, with_sightings
from jaxslam.pose import IDENTITY, between, to_local
from jaxslam.recall import recall
from jaxslam.rotation import axis_rotation
from jaxslam.slam import Slam
from jaxslam.tracked import Tracked

POINTS = 100


def at(x: float = 0.0, z: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """A pose that was moved to the right and ahead, and then turned about the vertical."""
    return np.concatenate([axis_rotation(1, np.array(turn)), [x, 0, z]])


def seen_from(poses: list[np.ndarray], shown: list[int], submaps: list[int] | None = None) -> Map:
    """A wall of points two metres ahead of the origin, in keyframes that each show so many of them."""
    rng = np.random.default_rng(0)
    made = empty_map(CAMERA)
    submaps = [0] * len(poses) if submaps is None else submaps
    for number, (pose, submap) in enumerate(zip(poses, submaps, strict=True)):
        first = submap not in made.submap
        parent = NONE if first else int(made.ids[made.submap == submap][0])
        made = with_keyframe(made, Keyframe(number, number, features(rng, POINTS), png(number)), pose, parent, submap)
    for submap in sorted(set(submaps)):
        ids = made.next_point + np.arange(POINTS)
        maker = int(made.ids[made.submap == submap][0])
        X = np.concatenate([rng.uniform(-0.5, 0.5, (2, POINTS)), np.full((1, POINTS), 2.0)])
        whole = np.ones(POINTS, np.float32)
        none, no_descriptor = np.zeros(POINTS, bool), np.zeros((POINTS, 32), np.uint8)
        made = with_points(made, MapPoints(ids, X, whole, no_descriptor, none, np.full(POINTS, maker, np.int64)))
        for number in np.flatnonzero(np.array(submaps) == submap):
            some = ids[: shown[number]]
            by_feature = np.where(np.arange(len(some)) % 2, NONE, np.arange(len(some)))
            made = with_sightings(made, sightings(made, np.full(len(some), number), some, by_feature, rng))
    return made


BEHIND = at(z=4.0, turn=np.pi)


class TestWorthRecalling:
    def test_those_that_show_the_points_in_view_from_alike_directions(self) -> None:
        """Not from the other side, nor from so far or near that the pictures differ."""
        poses = [at(), at(x=0.3), BEHIND, at(z=-2.5), at(z=1.2), at(x=4.0, turn=-1.1), at(z=-1.5)]
        made = seen_from(poses, [POINTS] * len(poses))
        assert sorted(keyframes_in_view(made, at(), 0, set(), 9)) == [0, 1, 6]
        assert keyframes_in_view(made, BEHIND, 0, set(), 9) == [2]

    def test_most_points_first(self) -> None:
        made = seen_from([at(), at(x=0.1), at(x=0.2), at(x=0.3)], [70, 100, 50, 100])
        assert keyframes_in_view(made, at(), 0, set(), 9) == [1, 3, 0]  # fifty are too few
        assert keyframes_in_view(made, at(), 0, set(), 2) == [1, 3]
        assert keyframes_in_view(made, at(), 0, {1}, 2) == [3, 0]
        assert keyframes_in_view(made, at(), 0, {0, 1, 3}, 2) == []

    def test_only_what_is_in_view(self) -> None:
        made = seen_from([at()], [POINTS])
        assert keyframes_in_view(made, at(x=3.0), 0, set(), 9) == []
        assert keyframes_in_view(made, at(turn=np.pi), 0, set(), 9) == []

    def test_of_the_submap(self) -> None:
        """Another one has its own world: what is at the same place there is somewhere else."""
        made = seen_from([at(), at(x=0.1), at()], [POINTS] * 3, [0, 0, 1])
        assert keyframes_in_view(made, at(), 0, set(), 9) == [0, 1]
        assert keyframes_in_view(made, at(), 1, set(), 9) == [2]
        assert keyframes_in_view(made, at(), 2, set(), 9) == []

    def test_of_an_empty_map(self) -> None:
        assert keyframes_in_view(empty_map(CAMERA), IDENTITY, 0, set(), 4) == []


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
