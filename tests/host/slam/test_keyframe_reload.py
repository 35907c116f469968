"""Recalling keyframes: what the tracker gets, and what it gains."""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_map import png
from small_scene import HEIGHT, TRACK, WIDTH
from wall_map import POINTS, at, seen_from

from jaxslam.config.schema import Config, SemanticsConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import between, to_local
from jaxslam.mapping.track_table import TrackId
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.keyframe_reload import reload_keyframe
from jaxslam.slam.slam import Slam


class TestRecall:
    def test_points(self) -> None:
        """They are those of the map in the keyframe's axes, the most exact first: those that flow tracked."""
        made = seen_from([at(), at(x=0.3)], [POINTS, POINTS])
        keyframe = reload_keyframe(made, 1, 120)
        assert keyframe.keyframe == 1
        np.testing.assert_array_equal(keyframe.image, cv2.imdecode(np.frombuffer(png(1), np.uint8), 0))
        ids = -1 - keyframe.id[:POINTS].astype(np.int64)
        np.testing.assert_array_equal(TrackId.of_map_points(ids), keyframe.id[:POINTS])
        np.testing.assert_array_equal(ids, [*range(1, POINTS, 2), *range(0, POINTS, 2)])
        np.testing.assert_allclose(
            keyframe.X_cam[:, :POINTS], to_local(at(x=0.3), made.points.X_world[:, ids]), atol=1e-6
        )
        mine = made.observations.keyframe == 1
        np.testing.assert_array_equal(keyframe.uv_raw[:, :POINTS], made.observations.uv_raw[:, mine][:, ids])
        np.testing.assert_array_equal(keyframe.weight[:POINTS], made.observations.weight[mine][ids])
        assert not keyframe.weight[POINTS:].any()

    def test_no_more_than_there_is_room_for(self) -> None:
        keyframe = reload_keyframe(seen_from([at()], [POINTS]), 0, 30)
        assert keyframe.uv_raw.shape == (2, 30)
        np.testing.assert_array_equal(-1 - keyframe.id, range(1, 61, 2))

    def test_damaged_image(self) -> None:
        made = seen_from([at()], [POINTS])
        damaged = made._replace(keyframes=(made.keyframes[0]._replace(image_file=b"no picture"),))
        with pytest.raises(RuntimeError, match="image of keyframe 0 cannot be decoded"):
            reload_keyframe(damaged, 0, 30)


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
    @pytest.mark.slow
    def test_finds_their_points_again(self) -> None:
        """Back where the ring of keyframes has moved on from, the tracker finds more, and is no less right."""
        frames, truth = _there_and_back()
        late = slice(len(frames) - 40, len(frames))
        keyframe_matches, errors = {}, {}
        for num_reloaded in (0, 4):
            with Slam(_camera(), Config(track=replace(SMALL_RING, num_reloaded=num_reloaded))) as slam:
                results: list[FrameResult] = [slam.track(frame) for frame in frames]
            poses = np.array([result.T_world_cam for result in results])
            keyframe_matches[num_reloaded] = np.mean([result.num_keyframe_matches for result in results[late]])
            errors[num_reloaded] = np.sqrt(np.square(poses[late, 4:] - truth[late, 4:]).sum(axis=1).mean())
        print(f"points found again {keyframe_matches}, errors {errors}")
        assert keyframe_matches[4] > 1.1 * keyframe_matches[0]
        assert errors[4] < 1.1 * errors[0]

    @pytest.mark.slow
    def test_a_way_that_is_known_makes_hardly_a_keyframe(self) -> None:
        """To and fro three times: the map grows with what it shows, and the pose is as right as the first time."""
        frames, truth = _there_and_back()
        turn = len(frames) - 1
        passes = [replace(frames[index % turn], timestamp_ns=index * 66_666_666) for index in range(3 * turn)]
        with Slam(_camera(), Config(track=SMALL_RING, semantics=SemanticsConfig(model=None))) as slam:
            results = [slam.track(frame) for frame in passes]
        kept = np.array([result.is_keyframe for result in results]).reshape(3, turn).sum(axis=1)
        places = np.array([result.T_world_cam[4:] for result in results]).reshape(3, turn, 3)
        errors = np.sqrt(np.square(places - truth[:turn, 4:]).sum(axis=2).mean(axis=1))
        print(f"keyframes {kept}, errors {errors}")
        assert kept[1:].sum() <= 0.2 * kept[0]
        assert errors[2] < 1.2 * errors[0]


def _camera() -> Camera:
    return SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=1, people=0, path="loop", fps=15)).camera
