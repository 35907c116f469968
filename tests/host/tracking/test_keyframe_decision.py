"""When a keyframe is made: as soon as there is a reason, or at the right moment after."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from jaxslam import load_config
from jaxslam.sensors.camera import Camera
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.keyframe_decision import KeyframeCandidate, keyframe_reason
from jaxslam.tracking.state import KeyframeReason

N = 64
CAMERA = Camera("test", 64, 48, 50.0, 50.0, 31.5, 23.5, depth_scale_per_m=5000.0)
CONFIG = load_config(overrides=(f"track.num_points={N}", "track.num_levels=2", "track.keyframe_points_below=0.5"))
PARAMS = track_params(CAMERA, CONFIG.track)
AS_NEEDED = track_plan(CONFIG.track)
SPARING = AS_NEEDED._replace(keyframe_policy="sparing")
DUE_S = CONFIG.track.keyframe_min_s
PATIENCE_S = CONFIG.track.keyframe_patience_s


def _reason(
    plan=SPARING,
    *,
    moved_m=1.0,
    since_s=1.0,
    overlap: float | tuple[float, ...] = 0.5,
    new=0,
    recognized=0.8,
    map_views=0,
    map_changed=False,
    movable=0.0,
    tracked=N,
    weak=False,
    lost=False,
    started=False,
    has_depth=True,
) -> KeyframeReason:
    """Why a frame is kept that shows points 2 m away, after the camera has moved since a keyframe at the origin.

    `overlap` is the share of the points of each keyframe in view, or that of the only one; `new` counts the points that
    are younger than it.
    """
    state = init_state(48, 64, plan)
    rng = np.random.default_rng(0)
    X_world = jnp.asarray(rng.uniform([-1, -1, 2], [1, 1, 2.1], (N, 3)).T, jnp.float32)
    state = state._replace(keyframes=state.keyframes._replace(made=jnp.ones((), jnp.int32)))
    pose = jnp.array([1, 0, 0, 0, moved_m, 0, 0], jnp.float32)
    number = lambda value: jnp.asarray(value, jnp.float32)
    points = state.points._replace(X_world=X_world, age=jnp.where(jnp.arange(N) < new, 0, 5).astype(jnp.int32))
    candidate = KeyframeCandidate(
        T_world_cam=SE3(pose),
        points=points,
        tracked=jnp.arange(N) < tracked,
        overlap=jnp.atleast_1d(number(overlap)),
        recognized=number(recognized),
        lost=jnp.asarray(lost),
        weak=jnp.asarray(weak),
        started=jnp.asarray(started),
        since_keyframe_s=number(since_s),
        movable=number(movable),
        has_depth=jnp.asarray(has_depth),
    )
    params = PARAMS._replace(map_views=number(map_views), map_changed=number(map_changed))
    return KeyframeReason(int(keyframe_reason(state, candidate, params, plan)))


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_a_new_area_is_a_reason(plan) -> None:
    assert _reason(plan) == KeyframeReason.NEW_AREA
    assert _reason(plan, overlap=0.9) == KeyframeReason.NONE
    assert _reason(plan, overlap=(0.1, 0.9, 0.3)) == KeyframeReason.NONE
    views = CONFIG.track.keyframe_views
    assert _reason(plan, map_views=views - 1) == KeyframeReason.NEW_AREA
    assert _reason(plan, map_views=views) == KeyframeReason.NONE  # shown by those that the tracker does not hold


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_a_turnover_of_points_is_one_until_keyframes_enough_show_the_view(plan) -> None:
    views = CONFIG.track.keyframe_views
    turned_over = partial(_reason, plan, new=int(0.95 * N), recognized=0.2)
    assert turned_over(overlap=0.9) == KeyframeReason.FEW_FOLLOWED
    assert turned_over(overlap=0.9, map_views=views - 1) == KeyframeReason.FEW_FOLLOWED
    assert turned_over(overlap=0.9, map_views=views) == KeyframeReason.NONE
    assert turned_over(overlap=(0.9,) * views) == KeyframeReason.NONE
    assert turned_over(overlap=0.9, recognized=0.65) == KeyframeReason.NONE  # the map shows what the frame does
    assert _reason(plan, overlap=0.9, new=N // 2) == KeyframeReason.NONE


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_more_keyframes_where_the_view_is_hardly_recognized(plan) -> None:
    """A crowd, or another light: but not without end."""
    views = CONFIG.track.keyframe_views
    hardly = partial(_reason, plan, new=int(0.95 * N), overlap=0.9, recognized=0.01)
    assert hardly(map_views=views) == KeyframeReason.FEW_FOLLOWED
    assert hardly(map_views=4 * views) == KeyframeReason.NONE


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_weak_tracking_is_one_unless_keyframes_enough_show_the_view(plan) -> None:
    """Points come from those keyframes; a frame with hardly any of its own has none for the map."""
    views = CONFIG.track.keyframe_views
    weak = partial(_reason, plan, overlap=0.9, new=int(0.95 * N), recognized=0.2, weak=True)
    assert weak() == KeyframeReason.WEAK
    assert weak(since_s=0.1) == KeyframeReason.NONE
    assert weak(map_views=views - 1) == KeyframeReason.WEAK
    assert weak(map_views=views) == KeyframeReason.NONE


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_a_change_of_the_map_is_one(plan) -> None:
    changed = partial(_reason, plan, overlap=0.9, map_changed=True)
    assert changed() == KeyframeReason.CHANGED
    assert changed(map_views=100) == KeyframeReason.CHANGED  # as well known as it was
    assert changed(since_s=0.1) == KeyframeReason.NONE
    assert changed(lost=True) == KeyframeReason.NONE


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_it_waits_for_depth(plan) -> None:
    turned_over = {"overlap": 0.9, "new": int(0.95 * N), "recognized": 0.2}
    for cause in ({}, turned_over, {"overlap": 0.9, "weak": True}, {"overlap": 0.9, "map_changed": True}):
        assert _reason(plan, **cause) != KeyframeReason.NONE
        assert _reason(plan, **cause, has_depth=False) == KeyframeReason.NONE


def test_not_soon_after_the_last_one() -> None:
    soon = 0.5 * DUE_S
    assert _reason(AS_NEEDED, since_s=soon, overlap=0.75) == KeyframeReason.NEW_AREA
    assert _reason(since_s=soon, overlap=0.75) == KeyframeReason.NONE
    assert _reason(since_s=DUE_S + 1e-3, overlap=0.75) == KeyframeReason.NEW_AREA
    assert _reason(since_s=soon, overlap=0.2) == KeyframeReason.NEW_AREA  # hardly anything is left of it


def test_not_without_motion() -> None:
    assert _reason(AS_NEEDED, moved_m=0.01) == KeyframeReason.NEW_AREA
    assert _reason(moved_m=0.01) == KeyframeReason.NONE


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_time_alone_is_no_reason(plan) -> None:
    assert _reason(plan, since_s=3600.0, overlap=0.9) == KeyframeReason.NONE


def test_not_while_much_may_move_unless_that_lasts() -> None:
    assert _reason(since_s=DUE_S + 1e-3, movable=0.5) == KeyframeReason.NONE
    assert _reason(since_s=DUE_S + PATIENCE_S + 1e-3, movable=0.5) == KeyframeReason.NEW_AREA
    assert _reason(AS_NEEDED, since_s=DUE_S + 1e-3, movable=0.5) == KeyframeReason.NEW_AREA


@pytest.mark.parametrize("plan", [AS_NEEDED, SPARING])
def test_at_once_when_points_are_few(plan) -> None:
    at_a_bad_moment = partial(_reason, plan, since_s=0.01, moved_m=0.0, movable=0.9, overlap=0.9)
    assert at_a_bad_moment(tracked=N // 5) == KeyframeReason.FEW_POINTS
    assert at_a_bad_moment(tracked=N) == KeyframeReason.NONE


def test_lost_and_started() -> None:
    assert _reason(lost=True) == KeyframeReason.NONE
    assert _reason(started=True, since_s=0.0, moved_m=0.0) == KeyframeReason.STARTED
