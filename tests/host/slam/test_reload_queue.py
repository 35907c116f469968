"""Keyframes that wait to be loaded into the tracker: their order, and points that have left the map."""

from typing import Any

import jax
import numpy as np
import pytest
from small_map import CAMERA, small_map

from jaxslam.map.edit import without_points
from jaxslam.map.point_records import NONE
from jaxslam.mapping.track_table import TrackId
from jaxslam.slam.keyframe_reload import reload_keyframe
from jaxslam.slam.reload_queue import ReloadQueue
from jaxslam.slam.tracker_map_sync import TrackerMapSync
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackPlan

PLAN = TrackPlan(num_points=8, num_levels=2, num_keyframes=3, num_reloaded=2, num_sources=1, points_per_source=4)
RELOADED = slice(PLAN.num_keyframes, None)


@pytest.fixture(scope="module")
def blank() -> Any:
    return jax.device_get(init_state(CAMERA.height, CAMERA.width, PLAN))


def queue(num_keyframes: int = 6, *, points_may_leave: bool = False) -> tuple[TrackerMapSync, ReloadQueue]:
    link = TrackerMapSync(PLAN, small_map(num_keyframes, 6))
    return link, ReloadQueue(link, points_may_leave=points_may_leave)


def loaded(state: Any, link: TrackerMapSync) -> list[int]:
    """Ids of the keyframes in the slots for reloaded ones, by their poses."""
    poses = np.asarray(state.keyframes.T_world_cam)[RELOADED]
    distance = np.linalg.norm(poses[:, None, 4:] - link.map.T_world_cam[None, :, 4:], axis=-1)
    return [int(row.argmin()) if row.min() < 1e-5 else NONE for row in distance]


class TestOrder:
    def test_one_per_frame(self, blank: Any) -> None:
        link, reloads = queue()
        reloads.replace(reload_keyframe(link.map, number, PLAN.num_points) for number in (4, 2))
        state = reloads.load_next(jax.device_put(blank))
        assert loaded(state, link) == [4, NONE]
        state = reloads.load_next(state)
        assert loaded(state, link) == [4, 2]
        assert reloads.load_next(state) is state

    def test_all_at_once(self, blank: Any) -> None:
        link, reloads = queue()
        reloads.replace(reload_keyframe(link.map, number, PLAN.num_points) for number in (1, 3))
        assert loaded(reloads.load_all(jax.device_put(blank)), link) == [1, 3]

    def test_one_that_is_there_is_passed_over(self, blank: Any) -> None:
        """It keeps its slot, and the next one is loaded in its turn."""
        link, reloads = queue()
        state = jax.device_put(blank)
        for wanted, expected in (((1, 3), [1, 3]), ((3, 5), [5, 3])):
            reloads.replace(reload_keyframe(link.map, number, PLAN.num_points) for number in wanted)
            state = reloads.load_next(state)
            state = reloads.load_next(state)
            assert loaded(state, link) == expected

    def test_later_ones_replace_those_that_wait(self, blank: Any) -> None:
        link, reloads = queue()
        reloads.replace([reload_keyframe(link.map, 1, PLAN.num_points)])
        reloads.replace([reload_keyframe(link.map, 2, PLAN.num_points)])
        assert loaded(reloads.load_all(jax.device_put(blank)), link) == [2, NONE]
        reloads.replace([])
        state = jax.device_put(blank)
        assert reloads.load_next(state) is state


class TestPointsThatHaveLeft:
    @pytest.mark.parametrize("points_may_leave", [True, False])
    def test_do_not_count(self, blank: Any, *, points_may_leave: bool) -> None:
        """A keyframe was prepared from a map that had them; only a detector of keyframes removes points."""
        link, reloads = queue(points_may_leave=points_may_leave)
        keyframe = reload_keyframe(link.map, 1, PLAN.num_points)
        ids = TrackId.map_points(keyframe.id)
        gone = ids[keyframe.weight > 0][::2]
        link.map = without_points(link.map, gone)
        reloads.replace([keyframe])
        state = reloads.load_next(jax.device_put(blank))
        assert len(gone) > 2
        leaves = np.isin(ids, gone) & points_may_leave
        np.testing.assert_array_equal(
            state.keyframes.weight[PLAN.num_keyframes], np.where(leaves, np.float32(0), keyframe.weight)
        )
