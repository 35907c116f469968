"""Local mapping: what every step does to the map, on the synthetic room."""

import numpy as np
import pytest
from room_keyframes import PLAN, STEP, errors_of, mapped, new_keyframe, pose_errors
from room_views import features, room, sensor
from small_map import arrays, same

from jaxslam.geometry.se3 import between, compose, to_local, transform
from jaxslam.loop_closing.loop_detector import LoopClosure
from jaxslam.map.edit import with_positions, without_observations
from jaxslam.map.point_records import NONE, joined, observations_at, rows
from jaxslam.map.types import Map, covisible
from jaxslam.map.validate import problems
from jaxslam.mapping import local_mapping
from jaxslam.mapping.culling import CONFIRM_WITHIN, KEEP_LATEST, without_redundant, without_unconfirmed
from jaxslam.mapping.local_mapping import LocalMapping
from jaxslam.mapping.track_table import TrackId
from jaxslam.mapping.view_coverage import in_view, seen_alike

COUNT = 8


@pytest.fixture(scope="module")
def maps() -> list[Map]:
    """The map after every keyframe, each a whole one."""
    return mapped(COUNT)[1]


def test_every_map_is_whole_and_stays_as_it_was():
    mapping, before = LocalMapping(room().camera, sensor(), PLAN), {}
    for number in range(4):
        held = mapping.map
        before = {name: array.copy() for name, array in arrays(held).items()}
        mapping.add(new_keyframe(number, number * STEP, (number - 1) * STEP if number else None))
        assert problems(mapping.map) == []
        for name, array in arrays(held).items():
            np.testing.assert_array_equal(array, before[name])


def test_a_keyframe_costs_what_is_around_it_and_not_the_map():
    """It joins neither the map before it nor the one after, and shares the blocks of another room."""
    there = mapped(2)[1][-1]
    points, seen = there.points, there.observations
    apart = 1 << 20  # of ids, as of a room that was mapped later
    far = points._replace(ids=points.ids + apart, X_world=points.X_world + 100.0)
    both = there.with_arrays(joined([points, far]), seen)._replace(next_point=2 * apart)
    mapping = LocalMapping(room().camera, sensor(), PLAN, both)
    before = mapping.map.contents
    mapping.add(new_keyframe(2, 2 * STEP, STEP))
    after = mapping.map.contents
    for contents in (before, after):
        assert not {"points", "observations"} & set(vars(contents))
    shared = [number for number, block in after.blocks.items() if block is before.blocks.get(number)]
    assert len(shared) >= len(np.unique(far.ids >> 10))


def test_points_the_tracker_saw_get_a_observation_in_every_keyframe(maps):
    """Every track is one point all along, seen where the tracker saw it."""
    slam_map = maps[2]
    last = new_keyframe(2, 2 * STEP, STEP).tracks
    by_flow = slam_map.observations.sigma_px == np.float32(PLAN.track_sigma_px)
    seen = slam_map.observations.point[(slam_map.observations.keyframe == 2) & by_flow]
    assert np.count_nonzero(last.weight) * 0.97 < len(seen) <= np.count_nonzero(last.weight)
    for other in (0, 1):
        both = np.count_nonzero((last.weight > 0) & (new_keyframe(other, other * STEP, None).tracks.weight > 0))
        shared = np.intersect1d(seen, slam_map.observations.point[(slam_map.observations.keyframe == other) & by_flow])
        assert both * 0.95 < len(shared) <= both


def test_a_point_recalled_from_the_map_is_known_again():
    """The tracker starts anew and finds points of the map by their picture: it says so by their numbers."""
    mapping, _ = mapped(3, noisy=False)
    slam_map = mapping.map
    seen = np.flatnonzero((slam_map.observations.keyframe == 2) & (slam_map.observations.feature != NONE))[:50]
    ids, where = slam_map.observations.point[seen], slam_map.observations.uv_raw[:, seen]
    X_cam = to_local(slam_map.pose(2), slam_map.points.X_world[:, rows(slam_map.points.ids, ids)])
    again = new_keyframe(3, 2 * STEP, 2 * STEP)
    unknown = TrackId.of_map_points(np.array([slam_map.next_point + 10**6]))
    again = again._replace(
        tracks=again.tracks._replace(
            id=np.append(TrackId.of_map_points(ids), unknown),
            uv_raw=np.append(where, where[:, :1], axis=1),
            X_cam=np.append(X_cam, X_cam[:, :1], axis=1).astype(np.float32),
            weight=np.ones(51, np.float32),
        )
    )
    after = mapping.add(again)
    assert np.isin(ids, after.observations.point[after.observations.keyframe == 3]).mean() > 0.95
    assert problems(after) == []


def test_features_found_again_are_the_same_places(maps):
    """What was found is where the true poses put it: within the search radius of its octave, most within a pixel."""
    slam_map, truth = maps[-1], room().T_world_cam
    camera, by_descriptor = slam_map.camera, slam_map.observations.sigma_px > PLAN.track_sigma_px
    seen = observations_at(slam_map.observations, by_descriptor & (slam_map.observations.feature != NONE))
    focal, center = np.array([[camera.fx], [camera.fy]]), np.array([[camera.cx], [camera.cy]])
    errors = []
    for number in slam_map.ids[1:].tolist():
        here = seen.keyframe == number
        there = (seen.keyframe == number - 1) & (seen.depth > 0)
        _, i, j = np.intersect1d(seen.point[here], seen.point[there], return_indices=True)
        rays = np.concatenate([(seen.uv[:, there][:, j] - center) / focal, np.ones((1, len(j)))])
        X = transform(truth[(number - 1) * STEP], rays * seen.depth[there][j])
        local = to_local(truth[number * STEP], X)
        apart = local[:2] / local[2] * focal + center - seen.uv[:, here][:, i]
        errors.append(np.linalg.norm(apart, axis=0) / seen.sigma_px[here][i])
    error = np.concatenate(errors)
    assert len(error) > 400
    assert np.median(error) < 1
    assert np.mean(error < 4) > 0.98
    recognizable = slam_map.observations.feature != NONE
    views = np.unique(slam_map.observations.point[recognizable], return_counts=True)[1]
    assert np.mean(views >= 3) > 0.15


def test_every_feature_with_depth_is_a_point():
    slam_map = mapped(1)[1][0]
    depth = slam_map.keyframes[0].features.depth
    feature = slam_map.observations.feature[slam_map.observations.feature != NONE]
    assert np.isin(np.flatnonzero(depth > 0), feature).all()
    assert len(np.unique(feature)) == len(feature)


def test_features_without_depth_are_triangulated(maps):
    """Of a camera that measures no depth beyond the middle of the picture."""
    mapping = LocalMapping(room().camera, sensor(), PLAN)
    for number in range(4):
        new = new_keyframe(number, number * STEP, (number - 1) * STEP if number else None)
        depth = np.array(new.frame.depth)
        depth[:, 320:] = 0
        mapping.add(new._replace(frame=new.frame._replace(depth=depth)))
    slam_map = mapping.map
    assert problems(slam_map) == []
    seen = rows(slam_map.points.ids, slam_map.observations.point)
    measured = np.bincount(seen[slam_map.observations.depth > 0], minlength=len(slam_map.points.ids)) > 0
    made = ~measured & slam_map.points.has_descriptor
    assert np.count_nonzero(made) > 20
    errors = []
    for number in range(4):
        mine = (slam_map.observations.keyframe == number) & made[seen] & (slam_map.observations.feature != NONE)
        expected = to_local(slam_map.pose(number), slam_map.points.X_world[:, seen[mine]])[2]
        truth = features(number * STEP).depth[slam_map.observations.feature[mine]]  # of the whole picture
        errors.append(expected[truth > 0] / truth[truth > 0])
    ratio = np.concatenate(errors)
    assert np.abs(np.median(ratio) - 1) < 0.02
    assert np.mean(np.abs(ratio - 1) < 0.1) > 0.9


def test_adjustment_makes_keyframes_better_than_tracked(maps):
    errors = errors_of(3, COUNT)
    pose, tracked = room().T_world_cam[0], [np.zeros(3)]
    first = pose
    for number in range(1, COUNT):
        pose = compose(pose, new_keyframe(number, number * STEP, (number - 1) * STEP, error=errors[number])[4])
        tracked.append(between(first, pose)[4:])
    truth = between(room().T_world_cam[:1], room().T_world_cam[np.arange(COUNT) * STEP])[:, 4:]
    before = np.linalg.norm(np.array(tracked) - truth, axis=1)
    assert maps[-1].ids.tolist() == list(range(COUNT))
    after = pose_errors(maps[-1])
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    assert after.max() < 0.006


def test_same_input_same_bytes(maps):
    assert same(mapped(3)[1][-1], maps[2])


def test_unconfirmed_points_go_where_the_latest_keyframe_looks(maps):
    slam_map = maps[-1]
    latest = int(slam_map.ids[-1])
    counts = np.bincount(rows(slam_map.points.ids, slam_map.observations.point), minlength=len(slam_map.points.ids))
    old = slam_map.points.reference_keyframe <= latest - CONFIRM_WITHIN
    in_latest = in_view(slam_map.camera, slam_map.pose(latest), slam_map.points.X_world)
    assert counts.min() >= 1
    assert (counts[~old] == 1).any(), "nothing to confirm"
    assert without_unconfirmed(slam_map, latest).points.ids.tolist() == slam_map.points.ids.tolist()
    # Take away all but the first observation of some old points that the latest keyframe has in view.
    makers = slam_map.T_world_cam[rows(slam_map.ids, slam_map.points.reference_keyframe), 4:].T
    alike = seen_alike(slam_map.points.X_world, makers, slam_map.pose(latest)[4:, None])
    some = slam_map.points.ids[old & in_latest & alike][::3]
    _, first = np.unique(slam_map.observations.point, return_index=True)
    again = np.ones(len(slam_map.observations.point), bool)
    again[first] = False
    unconfirmed = without_observations(slam_map, again & np.isin(slam_map.observations.point, some))
    gone = slam_map.points.ids[~np.isin(slam_map.points.ids, without_unconfirmed(unconfirmed, latest).points.ids)]
    assert gone.tolist() == some.tolist()
    assert len(gone) > 20
    away = compose(slam_map.pose(latest), np.array([0.0, 0, 1, 0, 0, 0, 0]))
    none = np.zeros(0, np.int64)
    turned = with_positions(unconfirmed, np.array([latest]), away[None], none, np.zeros((3, 0)))
    assert without_unconfirmed(turned, latest).points.ids.tolist() == slam_map.points.ids.tolist()


def still(count: int) -> LocalMapping:
    """A camera that hardly moves: all keyframes see the same."""
    mapping = LocalMapping(room().camera, sensor(), PLAN)
    for number in range(count):
        mapping.add(new_keyframe(number, number % 3, (number - 1) % 3 if number else None))
    return mapping


CROWD = KEEP_LATEST + 4


@pytest.fixture(scope="module")
def crowded() -> Map:
    """Before any goes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(local_mapping, "without_redundant", lambda slam_map, keyframe_id, among: slam_map)
        return still(CROWD).map


class TestRedundant:
    def test_those_that_see_nothing_new_go_but_for_the_first_and_the_latest(self, crowded):
        latest = CROWD - 1
        after = without_redundant(crowded, latest, crowded.ids)
        assert sorted(after.culled.ids.tolist()) == [1, 2, 3]
        assert after.ids.tolist() == [0, *range(4, CROWD)]
        assert problems(after) == []
        assert without_redundant(crowded, latest, np.array([0, 2, 9])).culled.ids.tolist() == [2]

    def test_those_that_see_more_exactly_stay(self, crowded):
        """Others that see the points by features two levels coarser do not replace one; a level does not matter."""
        seen = crowded.observations
        for factor, stays in ((1.2, False), (1.44, True)):
            sigma = np.where(seen.keyframe == 2, 1, np.float32(factor)) * seen.sigma_px
            slam_map = crowded.with_arrays(observations=seen._replace(sigma_px=sigma.astype(np.float32)))
            assert (2 in without_redundant(slam_map, CROWD - 1, np.array([2])).ids) == stays

    def test_those_with_enough_of_their_own_stay(self, crowded):
        """If a fifth of its points are its own, a keyframe stays."""
        mine = np.unique(crowded.observations.point[crowded.observations.keyframe == 2])[::5]
        others = (crowded.observations.keyframe != 2) & np.isin(crowded.observations.point, mine)
        slam_map = without_observations(crowded, others)
        assert 2 in without_redundant(slam_map, CROWD - 1, np.array([2])).ids


def test_a_parent_that_was_culled_holds_a_keyframe_nevertheless():
    mapping = still(KEEP_LATEST + 4)
    gone = int(mapping.map.culled.ids[0])
    number = mapping.map.next_keyframe
    truth = room().T_world_cam
    new = new_keyframe(number, STEP, gone % 3)._replace(parent=gone)
    slam_map = mapping.add(new)
    assert problems(slam_map) == []
    assert slam_map.parent[-1] in slam_map.ids
    apart = between(between(truth[0], truth[STEP]), between(slam_map.pose(0), slam_map.pose(number)))
    assert np.linalg.norm(apart[4:]) < 0.005


def test_loop_between_submaps_makes_one_of_them():
    mapping, _ = mapped(3, noisy=False)
    off = np.r_[np.cos(0.3), 0, 0, np.sin(0.3), 1.0, 2.0, 3.0]
    truth = room().T_world_cam
    for number in range(3, 6):
        new = new_keyframe(number, (number - 3) * STEP + 4, (number - 4) * STEP + 4 if number > 3 else None)
        pose = compose(off, truth[4]) if number == 3 else new.T_parent_keyframe
        tracks = new.tracks._replace(id=new.tracks.id + 10**6)
        mapping.add(new._replace(submap=1, T_parent_keyframe=pose, tracks=tracks))
    before = mapping.map
    assert before.submap.tolist() == [0, 0, 0, 1, 1, 1]
    nothing = np.zeros(0, np.int64), np.zeros((0, 7))
    measured = between(truth[STEP], truth[STEP + 4])
    closed = mapping.close_loop(LoopClosure(1, 4, measured, np.eye(6) * 1e4, *nothing))
    assert problems(closed) == []
    assert closed.submap.tolist() == [0] * 6
    assert closed.parent.tolist() == [NONE, 0, 1, 4, 1, 4]  # the tree leads over the loop
    for number in range(6):
        index = number * STEP if number < 3 else (number - 3) * STEP + 4
        apart = between(between(truth[0], truth[index]), between(closed.pose(0), closed.pose(number)))
        assert np.linalg.norm(apart[4:]) < 0.005
    assert len(closed.points.ids) < len(before.points.ids) - 100, "nothing was recognized as the same"
    assert covisible(closed, 4, at_least=30)[0][0] in (0, 1, 2, 3, 5)
    again = mapping.close_loop(LoopClosure(1, 77, measured, np.eye(6), *nothing))
    assert again is mapping.map
