"""Things that may move: the objects of a mask, whether each moves, and what becomes of that over frames."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from parked_object import WITHIN, verdicts
from quick_compile import quick_compile_nested

from jaxslam import Slam, load_config
from jaxslam.dynamics.object_motion import (
    INERT,
    MeasuredPoints,
    MotionMemory,
    MotionState,
    classify_motion,
    inert_objects,
    labels_at,
    no_motion,
    object_numbers,
)
from jaxslam.dynamics.regions import RegionCueResult
from jaxslam.masks.box_to_mask import dilated
from jaxslam.masks.depth_instances import InstanceFinder, object_labels
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import frame_arrays
from jaxslam.tracking.cue_registry import with_cue_params, with_cues
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.step import track_step

CAMERA = Camera("test", 320, 240, 260.0, 260.0, 159.5, 119.5, depth_scale_per_m=5000.0)
CONFIG = load_config("usd")
PARAMS = with_cue_params(track_params(CAMERA, CONFIG.track), CONFIG.dynamics)
PLAN = with_cues(track_plan(CONFIG.track), CONFIG.dynamics)
N, NOISE_M = 60, 0.004
ON = np.repeat([0, 1, 2], N // 3).astype(np.int32)
"""Points on nothing, on thing 1 and on thing 2."""


def _motion(**changes: float) -> Any:
    assert PARAMS.motion is not None
    return PARAMS.motion._replace(**{key: jnp.asarray(value) for key, value in changes.items()})


_classify = quick_compile_nested(classify_motion, static_argnames="as_published")


def _judged(
    moved_m: dict[int, float],
    before: MotionMemory,
    seed: int = 0,
    of_point=ON,
    *,
    as_published: bool = False,
    inert: jax.Array | None = None,
    **changes: Any,
) -> MotionState:
    """Two things of which each has gone so far to the side since the last frame."""
    rng = np.random.default_rng(seed)
    X_world = rng.uniform([-1, -1, 1.5], [1, 1, 2.5], (N, 3)).T.astype(np.float32)
    way = sum((np.where(of_point == thing, far_m, 0.0) for thing, far_m in moved_m.items()), np.zeros(N))
    X_cam = X_world + rng.normal(0, NOISE_M, (3, N)).astype(np.float32) + np.array([[1.0], [0], [0]]) * way
    sigma = np.full((3, N), NOISE_M, np.float32)
    points = MeasuredPoints(
        jnp.asarray(X_world), jnp.asarray(X_cam, jnp.float32), jnp.asarray(sigma), jnp.ones(N, bool)
    )
    background = jnp.asarray((of_point == 0).astype(np.float32))
    limits, pose = _motion(**changes), SE3.identity()
    return _classify(
        *(points, jnp.asarray(of_point), background, pose, before, limits), inert=inert, as_published=as_published
    )


def _start() -> MotionMemory:
    return no_motion(PLAN.motion, N, jnp.dtype(jnp.float32))


def _over(frames: list[dict[int, float]], memory: MotionMemory, **changes: Any) -> list[list[bool]]:
    """Whether each of two things is at rest, in every frame."""
    said = []
    for seed, moved_m in enumerate(frames):
        state = _judged(moved_m, memory, seed, **changes)
        memory = state.memory
        said.append(np.asarray(state.at_rest[:2]).tolist())
    return said


def test_one_of_two_things_moves() -> None:
    state = _judged({2: 0.05}, _start())
    assert np.asarray(state.verdict.known[:3]).tolist() == [True, True, False]
    assert state.verdict.evidence[0] < 1 < state.verdict.evidence[1]
    assert not state.at_rest.any()  # one frame proves nothing


def test_hysteresis() -> None:
    """Three frames at rest before a thing counts, two of motion before it does not."""
    rest, go = {1: 0.0}, {1: 0.05}
    said = [one for one, _ in _over([rest] * 4 + [go] * 3 + [rest] * 3, _start())]
    assert said == [False, False, True, True, True, False, False, False, False, True]
    one_frame = [one for one, _ in _over([rest] * 4 + [go] + [rest] * 3, _start())]
    assert all(one_frame[2:])  # a single bad frame is not heard


def test_a_thing_is_known_again_by_its_points() -> None:
    """Labels change places, what is remembered does not."""
    memory = _start()
    for seed in range(4):
        memory = _judged({2: 0.05}, memory, seed).memory
    assert np.asarray(memory.at_rest[:2]).tolist() == [True, False]
    swapped = np.select([ON == 1, ON == 2], [2, 1], 0).astype(np.int32)
    state = _judged({1: 0.05}, memory, 9, of_point=swapped)
    assert np.asarray(state.at_rest[:2]).tolist() == [False, True]
    fresh = _judged({}, memory, 10, of_point=np.where(ON == 1, 3, 0).astype(np.int32))
    assert bool(fresh.at_rest[2])  # wherever it is in the list
    gone = _judged({}, memory, 11, of_point=np.zeros(N, np.int32))
    assert not gone.at_rest.any()


def test_a_thing_with_few_points_keeps_what_was_known() -> None:
    memory = _start()
    for seed in range(4):
        memory = _judged({2: 0.05}, memory, seed).memory
    few = np.where(np.arange(N) % 10 == 0, ON, 0).astype(np.int32)
    state = _judged({1: 0.05}, memory, 5, of_point=few)
    assert not state.verdict.known.any()
    assert np.asarray(state.at_rest[:2]).tolist() == [True, False]


def test_what_does_not_move_by_itself_is_at_rest_until_it_moves() -> None:
    """A chair is as good as the background at once, a person is not; both move when they are seen to."""
    inert = jnp.zeros(PLAN.motion.num_objects, bool).at[0].set(True) if PLAN.motion else None
    go = {1: 0.05, 2: 0.05}
    said = _over([{}, go, go, go], _start(), inert=inert)
    assert said == [[True, False], [True, False], [False, False], [False, False]]


def test_labels_of_what_does_not_move_by_itself() -> None:
    labels = np.zeros((4, 6), np.uint8)
    labels[0], labels[1], labels[2] = 1, INERT + 2, INERT + 3
    uv = jnp.array([[0.0, 5.0, 2.0], [0.0, 1.0, 3.0]], jnp.float32)
    codes = labels_at(jnp.asarray(labels), uv)
    assert np.asarray(object_numbers(codes)).tolist() == [1, 2, 0]
    assert np.asarray(inert_objects(codes, 4)).tolist() == [False, True, False, False]
    memory = MotionMemory(object_numbers(codes), jnp.zeros(4), jnp.zeros(4, bool))
    state = MotionState(jnp.ones(3, bool), RegionCueResult(jnp.ones(4), jnp.zeros(4), jnp.zeros(4, bool)), memory)
    moving = np.asarray(state.moving_pixels(jnp.asarray(labels)))
    assert moving[:, 0].tolist() == [True, True, False, False]  # nothing is known of an object without points


def test_share_of_points() -> None:
    """As published a thing is at rest while 70 % of its points are, whatever the others do."""
    for share, expected in ((0.25, True), (0.4, False)):
        moving = (np.arange(N) % 20) < round(20 * share)
        on = np.where(ON == 1, np.where(moving, 5, 1), 0)
        rng = np.random.default_rng(0)
        X_world = rng.uniform([-1, -1, 1.5], [1, 1, 2.5], (N, 3)).T.astype(np.float32)
        X_cam = X_world + rng.normal(0, NOISE_M, (3, N)) + np.where(on == 5, 0.2, 0.0) * np.array([[1.0], [0], [0]])
        points = MeasuredPoints(
            jnp.asarray(X_world), jnp.asarray(X_cam, jnp.float32), jnp.ones((3, N)), jnp.ones(N, bool)
        )
        background = jnp.asarray((ON == 0).astype(np.float32))
        pose, limits = SE3.identity(), _motion()
        state = classify_motion(points, jnp.asarray(ON), background, pose, _start(), limits, as_published=True)
        assert (state.verdict.weight[0] == 1) == expected, share


def test_the_whole_moves_by_less_than_a_point_shows() -> None:
    """Two deviations a point: most are below the limit of single points, their mean is not."""
    way = {2: 2.2 * NOISE_M}
    corrected, published = _judged(way, _start()), _judged(way, _start(), as_published=True)
    assert corrected.verdict.evidence[1] > 1
    assert published.verdict.evidence[1] < 1


def test_soft_verdict_has_a_derivative_and_a_limit() -> None:
    hard = _judged({2: 0.05}, _start()).verdict.weight
    cold = _judged({2: 0.05}, _start(), temperature=1e-3).verdict.weight
    np.testing.assert_allclose(np.asarray(hard)[:2], np.asarray(cold)[:2], atol=1e-3)

    def weight(sigmas: jax.Array) -> jax.Array:
        return _judged({2: 0.02}, _start(), temperature=0.5, sigmas=sigmas).verdict.weight[1]

    slope, step = float(jax.grad(weight)(jnp.float32(3.0))), 0.05
    numeric = float(weight(jnp.float32(3 + step)) - weight(jnp.float32(3 - step))) / (2 * step)
    assert slope == pytest.approx(numeric, rel=0.05)
    assert slope > 0


def test_labels_outside_of_the_picture() -> None:
    labels = jnp.ones((4, 6), jnp.uint8)
    uv = jnp.array([[0.0, 5.4, 9.0, -3.0], [0.0, 3.4, 1.0, 1.0]], jnp.float32)
    assert np.asarray(labels_at(labels, uv)).tolist() == [1, 1, 0, 0]


def test_objects_are_divided_where_depth_has_a_step() -> None:
    mask, depth = np.zeros((120, 160), bool), np.full((120, 160), 4.0, np.float32)
    mask[20:90, 20:120] = True
    depth[20:90, 20:90], depth[20:90, 90:120] = 1.5, 2.5  # side by side, the left one larger and nearer
    labels = object_labels(mask, depth, 8)
    assert set(np.unique(labels[25:85, 25:85])) == {1}
    assert set(np.unique(labels[25:85, 95:115])) == {2}
    assert not labels[~mask].any()
    only = object_labels(mask, depth, 1)
    assert only.max() == 1


def test_a_hole_in_depth_belongs_to_the_object_around_it() -> None:
    mask, depth = np.zeros((120, 160), bool), np.full((120, 160), 4.0, np.float32)
    mask[20:90, 20:120] = True
    depth[20:90, 20:120] = 2.0
    depth[50:54, 60:64] = 0
    assert (object_labels(mask, depth, 8)[20:90, 20:120] == 1).all()


def test_what_is_in_no_object_is_left_out() -> None:
    finder = InstanceFinder(CAMERA, 4)
    mask, depth = np.zeros((240, 320), bool), np.full((240, 320), 2.0, np.float32)
    nothing = finder.divided(mask, depth)
    assert not nothing.labels.any()
    assert not nothing.rest.any()
    mask[100:200, 100:200] = True
    mask[10:14, 10:14] = True  # too small to be judged
    mask[100:200, 250:300], depth[100:200, 250:300] = True, 0  # without depth
    found = finder.divided(mask, depth)
    assert ((found.labels > 0) ^ found.rest)[mask].all()
    assert (found.labels[110:190, 110:190] == 1).all()
    assert found.rest[11, 11]
    assert found.rest[150, 275]
    with pytest.raises(Exception, match="h"):
        finder.divided(mask[:100], depth)


def test_objects_stay_inert_between_detections() -> None:
    finder = InstanceFinder(CAMERA, 4)
    mask, depth = np.zeros((240, 320), bool), np.full((240, 320), 4.0, np.float32)
    mask[60:200, 40:120], depth[60:200, 40:120] = True, 1.5  # a person
    mask[60:200, 120:200], depth[60:200, 120:200] = True, 2.5  # a chair
    mask[10:14, 10:14] = True  # a small part of it
    detected = np.where(mask, INERT + 2, 0).astype(np.uint8)
    detected[60:200, 40:116] = 1
    found = finder.divided(mask, depth, detected, 2)
    assert found.labels[100, 80] < INERT < found.labels[100, 160]
    assert not found.rest[11, 11]
    mask, depth = (np.roll(array, 8, axis=1) for array in (mask, depth))
    later = finder.divided(mask, depth)
    assert later.labels[100, 88] < INERT < later.labels[100, 168]
    assert not (finder.divided(mask, depth, np.zeros_like(detected), 2).labels >= INERT).any()  # the detector says so


def test_a_detection_of_the_frame_itself_divides_without_depth() -> None:
    """Two cars one behind the other, in a frame in which stereo matching has found no depth on them."""
    finder, depth = InstanceFinder(CAMERA, 4), np.zeros((240, 320), np.float32)
    detected = np.zeros((240, 320), np.uint8)
    detected[100:200, 50:150], detected[100:160, 150:200], detected[5:8, 5:8] = 2, 1, 3
    mask = dilated(detected > 0, 3)
    found = finder.divided(mask, depth, detected, 0)
    assert (found.labels[100:200, 50:150] == 1).all()  # the largest first
    assert (found.labels[100:160, 150:200] == 2).all()
    assert ((found.labels > 0) ^ found.rest)[mask].all()
    assert found.rest[6, 6]
    assert not finder.divided(mask, depth, detected, 1).labels.any()


def test_a_plan_with_motion_needs_labels() -> None:
    frame = Frame(0, np.zeros((240, 320), np.uint8), np.ones((240, 320), np.float32))
    arrays = jax.tree.map(jnp.asarray, frame_arrays(frame, 0.03))
    state = init_state(240, 320, PLAN)
    with pytest.raises(ValueError, match="movable"):
        track_step(state, arrays, PARAMS, PLAN)


@pytest.mark.slow
def test_what_the_caller_masks_is_left_out_in_any_case() -> None:
    rng = np.random.default_rng(0)
    image = (rng.uniform(size=(240, 320)) * 255).astype(np.uint8)
    mask = np.zeros((240, 320), bool)
    mask[50:150, 50:150] = True
    with Slam(CAMERA, load_config("usd", overrides=("semantics.model=null", "dynamics.new_surfaces=true"))) as slam:
        for number in range(8):
            frame = Frame(number * 33_000_000, image, np.full((240, 320), 2.0, np.float32), dynamic_mask=mask)
            assert slam.track(frame).dynamic_mask[mask].all()


@pytest.mark.slow
def test_a_box_that_is_pushed() -> None:
    """It stands, is pushed, and stands again: known within five frames, and the pose is good all the while.

    In twenty rooms, from the beginning to the end: `tests/benchmarks/test_bench_parked.py`.
    """
    found = verdicts(0, start=110, stop=330)
    assert len(found.changes()) == 2
    after = [found.known_after(change) for change in found.changes()]
    assert all(frames is not None and frames <= WITHIN for frames in after), after
    assert found.wrong_share(WITHIN) < 0.05
    assert np.sqrt(np.mean(found.error_m**2)) < 0.01
