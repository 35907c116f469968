"""`track_step` as a pure function: compiled or not, batched, scanned, traced once, in both precisions."""

import itertools
import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.flow.disparity import row_disparities
from jaxslam_kernels.pose.pose_refine import PoseStatus
from jaxslam_kernels.se3 import retract
from quick_compile import quick_compile
from small_scene import HEIGHT, PLAN, TRACK, WIDTH, at, clip, new_state, params, stacked

from jaxslam import FlowPlan
from jaxslam.config.loading import load_config
from jaxslam.config.schema import Config, SemanticsConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import between
from jaxslam.semantics import Detections, no_detections
from jaxslam.sensors import measurement
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import PreparedFrame, pixel_rays
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.slam import Slam
from jaxslam.tracking import pose_estimation as frame_pose
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.pose_estimation import measure_matches, refined_pose, worse_status
from jaxslam.tracking.state import (
    KeyframeMatches,
    KeyframeReason,
    TrackOutput,
    TrackParams,
    TrackPlan,
    TrackReason,
    TrackState,
    TrackStatus,
)
from jaxslam.tracking.state_updates import reset_at_pose
from jaxslam.tracking.step import track_step
from jaxslam.tracking.step_context import StepContext

COUNT = 12
SAME = {"twist": 1e-4 * 30, "covariance": 1e-7, "keyframe_matches.uv": 1e-2}
"""What is the same number in meters a second and square meters, where poses are the same to 1e-4.

Rounding decides whether the refinement takes its last step: compiled in another way, poses differ by 0 or by 5e-6 m.
So it does for the search of a point that is looked up, whose last step is up to 0.05 px long.
"""

Step = Callable[[TrackState, FrameArrays, TrackParams], tuple[TrackState, TrackOutput]]


class Counted:
    """`track_step`, compiled, with its traces counted."""

    def __init__(self) -> None:
        self.traces = 0

        @wraps(track_step)  # by its name XLA's code is found that other tests have kept
        def trace(state: TrackState, frame: FrameArrays, params: TrackParams) -> tuple[TrackState, TrackOutput]:
            self.traces += 1
            return track_step(state, frame, params, PLAN)

        self.step: Step = quick_compile(trace)


@pytest.fixture(scope="module")
def counted() -> Counted:
    return Counted()


@pytest.fixture(scope="module")
def frames() -> FrameArrays:
    return stacked(clip(2).frames[:COUNT])


def track(step: Step, frames: FrameArrays, seed: int = 0, **changes: Any) -> tuple[TrackState, list[TrackOutput]]:
    state, outputs = new_state(seed=seed), []
    for index in range(COUNT):
        state, output = step(state, at(frames, index), params()._replace(**changes))
        outputs.append(output)
    return state, outputs


def poses(outputs: list[TrackOutput]) -> np.ndarray:
    return np.array([output.T_world_cam.wxyz_xyz for output in outputs])


def described(tree: Any) -> list[tuple[tuple[int, ...], Any]]:
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


class TestShapes:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_state_keeps_shapes_and_types(self, dtype: type[np.floating]) -> None:
        recording = clip()
        with jax.enable_x64(dtype is np.float64):
            state = new_state(dtype)
            frame = at(stacked(recording.frames[:1], dtype), 0)
            after, output = jax.eval_shape(lambda s, f, p: track_step(s, f, p, PLAN), state, frame, params(dtype))
            assert jax.tree.structure(after) == jax.tree.structure(state)
            assert described(after) == described(state)
            assert output.T_world_cam.wxyz_xyz.dtype == dtype
            assert output.covariance.shape == (6, 6)
            assert output.uv.shape == (2, PLAN.num_points)


class TestInitialState:
    def test_takes_no_program(self, compiled: list[str]) -> None:
        jax.clear_caches()
        init_state(HEIGHT, WIDTH, PLAN, seed=3)
        assert compiled == []

    def test_a_program_may_take_all_its_memory(self) -> None:
        """No two arrays are one."""
        state = init_state(HEIGHT, WIDTH, PLAN)
        jax.block_until_ready(jax.jit(lambda state: state, donate_argnums=0)(state))


class TestCompiled:
    def test_tracks(self, counted: Counted, frames: FrameArrays) -> None:
        state, outputs = track(counted.step, frames)
        statuses = [int(output.status) for output in outputs]
        assert statuses == [TrackStatus.STARTED] + [TrackStatus.OK] * (COUNT - 1)
        assert int(state.frame) == COUNT

    def test_single_trace(self, counted: Counted, frames: FrameArrays) -> None:
        track(counted.step, frames)
        rolling = params().sensor._replace(readout_s=jnp.float32(0.01))
        track(counted.step, frames, seed=7, loss_scale=jnp.float32(2.0), sensor=rolling)
        assert counted.traces == 1

    def test_rows_read_in_reverse(self, counted: Counted, frames: FrameArrays) -> None:
        """Equal to a negative readout time, and unlike a positive one."""
        rolling, reversed_ = (params().sensor._replace(readout_s=jnp.float32(s)) for s in (0.02, -0.02))
        backward = frames._replace(readout_sign=-np.ones(COUNT, np.float32))
        forward, there, expected = (
            poses(track(counted.step, given, sensor=sensor)[1])
            for given, sensor in ((frames, rolling), (backward, rolling), (frames, reversed_))
        )
        np.testing.assert_array_equal(there, expected)
        assert np.abs(forward - there).max() > 1e-4

    @pytest.mark.slow
    def test_a_motion_from_outside(self, counted: Counted) -> None:
        """A frame that turns by a third of the picture is tracked from a prediction, and lost without."""
        turning = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=120, people=0, path="rpy"))
        pair = stacked([turning[60], turning[78]])
        first, second = at(pair, 0), at(pair, 1)
        start, _ = counted.step(new_state(), first, params())
        moved = jnp.asarray(between(*turning.T_world_cam[[60, 78]]), jnp.float32)
        _, lost = counted.step(start, second, params())
        step = quick_compile(
            lambda state, frame, params, pose: track_step(state, frame, params, PLAN, predicted=SE3(pose))
        )
        _, tracked = step(start, second, params(), moved)
        assert int(lost.status) == TrackStatus.LOST
        assert int(tracked.status) != TrackStatus.LOST
        np.testing.assert_allclose(tracked.T_world_cam.wxyz_xyz, moved, atol=0.02)
        with pytest.raises(TypeError, match="predicted"):
            jax.eval_shape(lambda: track_step(start, second, params(), PLAN, predicted=moved))  # pyright: ignore[reportArgumentType]

    def test_same_bytes_again(self, counted: Counted, frames: FrameArrays) -> None:
        first, second = (track(counted.step, frames) for _ in range(2))
        np.testing.assert_array_equal(poses(first[1]), poses(second[1]))

    @pytest.mark.slow
    def test_equals_uncompiled(self, counted: Counted, frames: FrameArrays) -> None:
        """Operation by operation, without `jit` around them, on a frame that has points, velocity and keyframes."""
        before, step = new_state(), 5
        for index in range(step):
            before, _ = counted.step(before, at(frames, index), params())
        compiled = counted.step(before, at(frames, step), params())
        directly = track_step(before, at(frames, step), params(), PLAN)
        assert int(compiled[1].status) == TrackStatus.OK
        assert int(compiled[1].num_keyframe_matches) > 0
        assert jax.tree.structure(directly) == jax.tree.structure(compiled)
        for (path, one), other in zip(
            jax.tree_util.tree_leaves_with_path(jax.device_get(directly)),
            jax.tree.leaves(jax.device_get(compiled)),
            strict=True,
        ):
            name = jax.tree_util.keystr(path)
            assert one.dtype == other.dtype, name
            if np.issubdtype(one.dtype, np.floating):
                field = "keyframe_matches.uv" if name.endswith("keyframe_matches.uv") else name.split(".")[-1]
                np.testing.assert_allclose(one, other, rtol=1e-5, atol=SAME.get(field, 1e-4), err_msg=name)
            else:
                np.testing.assert_array_equal(one, other, err_msg=name)

    @pytest.mark.slow
    def test_scan_equals_loop(self, counted: Counted, frames: FrameArrays) -> None:
        _, outputs = track(counted.step, frames)
        scan = quick_compile(
            lambda state, frames, given: lax.scan(lambda s, f: track_step(s, f, given, PLAN), state, frames)
        )
        state, scanned = scan(new_state(), frames, params())
        assert described(state) == described(new_state())
        np.testing.assert_allclose(scanned.T_world_cam.wxyz_xyz, poses(outputs), atol=1e-4)

    @pytest.mark.slow
    def test_vmap_equals_loop(self, counted: Counted, frames: FrameArrays) -> None:
        """Two recordings side by side, one of them a frame ahead."""
        batched = quick_compile(jax.vmap(lambda s, f, p: track_step(s, f, p, PLAN), in_axes=(0, 0, None)))
        both = lambda *trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
        singles, states = [new_state(), new_state()], both(new_state(), new_state())
        for index in range(5):
            pair = [at(frames, index), at(frames, index + 1)]
            states, outputs = batched(states, both(*pair), params())
            for which in range(2):
                singles[which], output = counted.step(singles[which], pair[which], params())
                np.testing.assert_allclose(outputs.T_world_cam.wxyz_xyz[which], output.T_world_cam.wxyz_xyz, atol=1e-4)
                assert int(outputs.status[which]) == int(output.status)


def _by_numpy(state: TrackState, path: Path) -> TrackState:
    np.savez(path, *jax.tree.leaves(state))
    with np.load(path) as leaves:
        return jax.tree.unflatten(jax.tree.structure(new_state()), list(leaves.values()))


def _by_equinox(state: TrackState, path: Path) -> TrackState:
    eqx.tree_serialise_leaves(path, state)
    return eqx.tree_deserialise_leaves(path, new_state())


def _by_pickle(state: TrackState, path: Path) -> TrackState:
    path.write_bytes(pickle.dumps(state))
    return pickle.loads(path.read_bytes())


class TestSaved:
    @pytest.mark.parametrize(("save", "name"), [(_by_numpy, "s.npz"), (_by_equinox, "s.eqx"), (_by_pickle, "s.pkl")])
    def test_goes_on_with_the_same_bytes(
        self, counted: Counted, frames: FrameArrays, tmp_path: Path, save: Callable[..., TrackState], name: str
    ) -> None:
        state, middle = new_state(seed=3), 4
        for index in range(middle):
            state, _ = counted.step(state, at(frames, index), params())
        other = save(state, tmp_path / name)
        for index in range(middle, middle + 4):
            state, output = counted.step(state, at(frames, index), params())
            other, again = counted.step(other, at(frames, index), params())
            assert int(output.status) == TrackStatus.OK
            jax.tree.map(np.testing.assert_array_equal, (state, output), (other, again))


class TestReason:
    """Of a frame in which tracking cannot begin."""

    def reason(self, counted: Counted, frame: FrameArrays) -> TrackReason:
        _, output = counted.step(new_state(), frame, params())
        assert int(output.status) == TrackStatus.LOST
        return TrackReason(int(output.reason))

    def test_corners_without_depth(self, counted: Counted, frames: FrameArrays) -> None:
        frame = at(frames, 0)
        assert self.reason(counted, frame._replace(depth=jnp.zeros_like(frame.depth))) is TrackReason.NO_DEPTH

    @pytest.mark.parametrize("image", [lambda image: image // 255, lambda image: jnp.full_like(image, 90)])
    def test_no_corners(self, counted: Counted, frames: FrameArrays, image: Callable[[Any], Any]) -> None:
        """As of gray values from 0 to 1 in compiled code, and of a wall in one color."""
        frame = at(frames, 0)
        reason = self.reason(counted, frame._replace(image=image(frame.image)))
        assert reason is TrackReason.NO_CORNERS
        assert "too few corners were found in the image" in reason.text

    def test_all_is_to_be_ignored(self, counted: Counted, frames: FrameArrays) -> None:
        frame = at(frames, 0)
        assert self.reason(counted, frame._replace(ignore=jnp.ones_like(frame.ignore))) is TrackReason.NO_CORNERS


class TestStatus:
    def test_points_of_keyframes_count(self, counted: Counted, frames: FrameArrays) -> None:
        """Keyframe points that agree tell the pose as well, however few points are followed."""
        state, _ = track(counted.step, frames)
        kept = state.points.valid & (jnp.cumsum(state.points.valid) <= int(0.8 * TRACK.weak_inliers))
        no_keyframes = state.keyframes._replace(weight=jnp.zeros_like(state.keyframes.weight))
        few = state._replace(points=state.points._replace(valid=kept))
        frame = at(frames, COUNT - 1)
        _, output = counted.step(few, frame, params())
        assert int(output.num_inliers) < TRACK.weak_inliers <= int(output.num_inliers + output.num_keyframe_matches)
        assert int(output.status) == TrackStatus.OK
        _, alone = counted.step(few._replace(keyframes=no_keyframes), frame, params())
        assert int(alone.num_keyframe_matches) == 0
        assert int(alone.status) == TrackStatus.WEAK


class TestPoseStatus:
    def test_of_tracked_frames(self, counted: Counted, frames: FrameArrays) -> None:
        _, outputs = track(counted.step, frames)
        statuses = [int(output.pose_status) for output in outputs]
        assert statuses == [PoseStatus.TOO_FEW_POINTS] + [PoseStatus.OK] * (COUNT - 1)

    def test_steps_of_the_plan_run_out(self, counted: Counted, frames: FrameArrays) -> None:
        """The refinement alone, from a pose some centimeters away."""
        state, _ = counted.step(new_state(), at(frames, 0), params())

        @quick_compile
        def status(state: TrackState, frame: FrameArrays, given: TrackParams) -> Any:
            view = PreparedFrame(frame, state.pyramid, state.elapsed_s)
            nothing, overlap = jnp.zeros(0), jnp.zeros(state.keyframes.id.shape[0])
            none = KeyframeMatches(
                jnp.zeros((3, 0)), jnp.zeros((2, 0)), nothing, jnp.zeros(0, jnp.int32), overlap, jnp.zeros(())
            )
            away, trust = retract(state.T_world_cam, jnp.full(6, 0.02)), state.points.valid.astype(jnp.float32)
            X_world, twist = state.points.X_world, state.twist
            rays = pixel_rays(state.points.uv, given.sensor)
            steps = [StepContext(state, view, given, PLAN._replace(pose_steps=steps)) for steps in (2, 25)]
            none_seen = measure_matches(steps[0], none, away, twist)
            seen = steps[0].measured(rays, X_world, away, twist)
            return [refined_pose(step, seen, trust, none, none_seen, away)[0].status for step in steps]

        found = [int(code) for code in status(state, at(frames, 0), params())]
        assert found == [PoseStatus.NOT_CONVERGED, PoseStatus.OK]

    def test_of_the_coarse_pose_counts_too(self) -> None:
        """Only where the refinement has nothing worse to say."""
        fine, stopped, few = (
            jnp.int32(code) for code in (PoseStatus.OK, PoseStatus.NOT_CONVERGED, PoseStatus.TOO_FEW_POINTS)
        )
        pairs = [(fine, fine), (stopped, fine), (fine, stopped), (few, fine), (stopped, few)]
        assert [int(worse_status(*pair)) for pair in pairs] == [fine, stopped, stopped, fine, few]

    @pytest.mark.slow
    @pytest.mark.parametrize("plan", [PLAN, PLAN.exact()], ids=["default", "exact"])
    def test_both_refinements_have_the_steps_of_the_plan(
        self, plan: TrackPlan, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        given: list[int] = []

        def watched(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            given.append(kwargs["max_steps"])
            return function(*args, **kwargs)

        for name in ("refine_pose", "ransac_pnp"):
            monkeypatch.setattr(frame_pose, name, partial(watched, getattr(frame_pose, name)))
        with jax.enable_x64(True):
            frame = at(stacked(clip().frames[:1], np.float64), 0)
            jax.eval_shape(partial(track_step, plan=plan), new_state(np.float64), frame, params(np.float64))
        assert given == [plan.pose_steps] * 2
        assert plan.pose_steps == (25 if plan is PLAN else 1000)


@pytest.mark.slow
def test_a_start_at_a_recognized_place_keeps_the_velocity(counted: Counted, frames: FrameArrays) -> None:
    """The second frame is predicted by it; one that is lost has none."""
    place, twist = jnp.array([1.0, 0, 0, 0, 0.2, 0, 0]), jnp.array([0.3, 0, 0, 0, 0.1, 0])
    state, output = counted.step(reset_at_pose(new_state(), place, twist), at(frames, 0), params())
    assert int(output.status) == TrackStatus.STARTED
    np.testing.assert_array_equal(output.twist, twist)
    np.testing.assert_array_equal(state.twist, twist)
    black = at(frames, 1)._replace(image=jnp.zeros_like(at(frames, 1).image))
    _, output = counted.step(state, black, params())
    assert int(output.status) == TrackStatus.LOST
    assert not np.asarray(output.twist).any()


@pytest.mark.slow
def test_pairs_are_matched_by_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Followed points, those looked up and new ones; with `exact` to the end: derivatives by pictures were 27 % off."""
    given: list[FlowPlan] = []

    def watched(*args: Any, **kwargs: Any) -> Any:
        given.append(kwargs["plan"])
        return row_disparities(*args, **kwargs)

    monkeypatch.setattr(measurement, "row_disparities", watched)
    plan = PLAN.exact()
    with jax.enable_x64(True):
        frame = at(stacked(clip().frames[:1], np.float64), 0)
        pair = frame._replace(right=frame.image)
        jax.eval_shape(partial(track_step, plan=plan), new_state(np.float64), pair, params(np.float64))
    assert set(given) == {plan.pair_flow}
    assert len(given) >= 3
    assert plan.pair_flow.finest.tolerance == plan.flow.finest.tolerance == plan.look_up.tolerance == 1e-10


LONGER = 30


RARE = {"keyframe_below": 0.0, "keyframe_followed_below": 0.0, "keyframe_weak_after_s": 1e3}
"""Thresholds under which no keyframe is made for want of what it shows."""
ALONE = PLAN._replace(num_sources=0, new_points="keyframes")


@pytest.fixture(scope="module")
def step() -> Step:
    return quick_compile(lambda s, f, p: track_step(s, f, p, ALONE))


@pytest.mark.slow
class TestFollowingAlone:
    """As the preset `static` has it: nothing is looked up, and new points come in keyframes only."""

    def outputs(self, step: Step, **changes: float) -> list[TrackOutput]:
        frames = stacked(clip(2).frames[:LONGER])
        given = params()._replace(**{name: jnp.float32(value) for name, value in changes.items()})
        state, outputs = init_state(HEIGHT, WIDTH, ALONE), []
        for index in range(LONGER):
            state, output = step(state, at(frames, index), given)
            outputs.append(output)
        return outputs

    @staticmethod
    def num_new(outputs: list[TrackOutput]) -> np.ndarray:
        """How many points each frame has that no frame had before."""
        seen: set[int] = set()
        new = []
        for output in outputs:
            now = set(np.asarray(output.id)[np.asarray(output.weights) > 0].tolist())
            new.append(len(now - seen))
            seen |= now
        return np.array(new)

    def test_nothing_is_looked_up(self, step: Step) -> None:
        outputs = self.outputs(step, keyframe_points_below=0.5, keyframe_weak_after_s=0.0)
        assert [int(output.status) for output in outputs] == [TrackStatus.STARTED] + [TrackStatus.OK] * (LONGER - 1)
        assert all(
            int(output.num_keyframe_matches) == 0 and output.keyframe_matches.uv.shape == (2, 0) for output in outputs
        )
        off = np.linalg.norm(poses(outputs)[:, 4:] - poses(self.outputs(step))[:, 4:], axis=1)
        assert off.max() < 0.05

    def test_new_points_come_in_keyframes(self, step: Step) -> None:
        outputs = self.outputs(step, keyframe_points_below=0.75)
        new, kept = self.num_new(outputs), np.array([int(output.keyframe) > 0 for output in outputs])
        print(f"{new.tolist()} new points, in keyframes {np.flatnonzero(kept).tolist()}")
        assert kept[0]
        assert kept[1:].any()
        assert (new[kept] > 0).all()
        assert not new[~kept].any()

    def test_points_run_out_without_keyframes(self, step: Step) -> None:
        outputs = self.outputs(step, **RARE)
        assert [int(output.keyframe) for output in outputs] == [KeyframeReason.STARTED] + [0] * (LONGER - 1)
        assert not self.num_new(outputs)[1:].any()
        num = np.array([np.count_nonzero(output.weights) for output in outputs])
        assert (np.diff(num) <= 0).all()

    def test_few_points_make_a_keyframe(self, step: Step) -> None:
        """The first time that fewer are followed than the share of the capacity, and never before."""
        outputs = self.outputs(step, **{**RARE, "keyframe_weak_after_s": 0.0}, keyframe_points_below=0.75)
        followed = np.array([np.count_nonzero(output.tracked) for output in outputs])
        reasons = [int(output.keyframe) for output in outputs]
        few = followed < 0.75 * TRACK.num_points
        assert few[1:].any()
        assert reasons == [KeyframeReason.STARTED, *np.where(few[1:], KeyframeReason.FEW_POINTS, 0).tolist()]

    @pytest.mark.parametrize(("share", "sooner"), [(0.4, False), (0.75, True)])
    def test_few_points_wait_for_a_while(self, step: Step, share: float, sooner: bool) -> None:
        """For a keyframe soon after another less than half as many must be followed."""
        wait_s, fps = 0.2, clip(2).camera.fps
        outputs = self.outputs(step, **{**RARE, "keyframe_weak_after_s": wait_s}, keyframe_points_below=share)
        followed = np.array([np.count_nonzero(output.tracked) for output in outputs])
        made = np.flatnonzero([int(output.keyframe) for output in outputs])
        gaps_s = np.diff(made) / fps
        soon = gaps_s <= wait_s
        print(f"keyframes {made.tolist()}, followed {followed[made].tolist()}")
        assert len(made) > 1
        assert (followed[made[1:]] < share * TRACK.num_points).all()
        assert (followed[made[1:]][soon] < 0.5 * share * TRACK.num_points).all()
        assert soon.any() == sooner


def slam_results(config: Config, num: int = LONGER, detector: Callable | None = None) -> list[FrameResult]:
    recording = clip(0)
    with Slam(recording.camera, config, detector=detector) as slam:
        results = [slam.track(frame) for frame in recording.frames[:num]]
        slam.finish()
    return results


class TestHeldToMap:
    @pytest.mark.parametrize("which", ["weak", "keyframes", "always"])
    @pytest.mark.slow
    def test_which_frames(self, which: str) -> None:
        """Matching begins as soon as the map has a keyframe."""
        track = replace(TRACK, match_map=which, keyframe_below=1.0)
        results = slam_results(Config(track=track, semantics=SemanticsConfig(model=None)))
        assert {result.status for result in results[1:]} == {TrackStatus.OK}
        matched = np.array([result.num_matched > 0 for result in results])
        kept = np.array([result.is_keyframe for result in results])
        assert kept.any()
        assert not kept.all()
        print(f"{which}: matched {np.flatnonzero(matched).tolist()}, keyframes {np.flatnonzero(kept).tolist()}")
        late = np.arange(LONGER) > 5
        expected = {"weak": np.zeros(LONGER, bool), "keyframes": kept, "always": np.ones(LONGER, bool)}[which]
        np.testing.assert_array_equal(matched[late], expected[late])


@pytest.mark.slow
class TestPresets:
    SMALL = tuple(
        f"track.{name}={getattr(TRACK, name)}"
        for name in ("num_points", "num_levels", "num_keyframes", "points_per_source", "num_hypotheses", "cell_px")
    )

    @pytest.mark.parametrize(
        ("name", "match_map", "looks_every"),
        [
            ("static", "always", None),
            ("ngd-detector", "always", 1),
            ("ngd-propagation", "always", 2),
            ("ngd-published", "keyframes", 2),
        ],
    )
    def test_run(self, name: str, match_map: str, looks_every: int | None) -> None:
        config = load_config(name, overrides=self.SMALL)
        assert (config.track.match_map, config.track.num_sources) == (match_map, 0)
        assert not config.dynamics.new_surfaces
        assert (config.semantics.model is None) == (looks_every is None)
        looks = itertools.count()

        def detector(image: np.ndarray) -> Detections:
            next(looks)
            return no_detections()

        results = slam_results(config, LONGER, None if looks_every is None else detector)
        assert results[0].status is TrackStatus.STARTED
        assert all(result.status is TrackStatus.OK for result in results[1:])
        assert not any(result.num_keyframe_matches for result in results)
        assert not any(result.dynamic_mask.any() for result in results)
        assert next(looks) == (0 if looks_every is None else 1 + math.ceil((LONGER - 1) / looks_every))
        matched = [result.num_matched > 0 for result in results[6:]]
        assert all(matched) if match_map == "always" else sum(matched) < len(matched)
