"""Cues in the tracker: by name in the settings, and a function of one's own, without a change to the package."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.pose.pose_refine import PoseStatus
from quick_compile import quick_compile
from small_scene import HEIGHT, PLAN, TRACK, WIDTH, at, clip, new_state, params, stacked

from jaxslam.config.loading import load_config, presets
from jaxslam.config.schema import Config, DynamicsConfig
from jaxslam.dynamics.cue import CueInput, CueResult, threshold_evidence
from jaxslam.dynamics.regions import Regions
from jaxslam.errors import ConfigError
from jaxslam.slam.slam import Slam
from jaxslam.tracking.cue_registry import with_cue_params, with_cues
from jaxslam.tracking.dynamic_rejection import DynamicRejection
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPlan, TrackState, TrackStatus
from jaxslam.tracking.step import track_step

FRAMES = 6
BY: dict[str, Callable[[TrackParams], Any]] = {
    "fx": lambda p: p.sensor.intrinsics.fx,
    "pixel_sigma": lambda p: p.pixel_sigma,
    "loss_scale": lambda p: p.loss_scale,
    "times_mean": lambda p: p.cues[0].times_mean,
    "robust_px": lambda p: p.cues[0].robust_px,
    "tolerance_m": lambda p: p.cues[1].tolerance_m,
    "temperature": lambda p: p.cues[1].temperature,
}
"""Parameters that the pose is differentiated by."""
AT_OPTIMUM_M = 1e-10
"""How far from the optimum the refinement may end in float64: it takes a step more on one side, or not."""
_step = quick_compile(track_step, static_argnames="plan")


def left_of(scene: CueInput, limit_px: Any) -> CueResult:
    """One's own cue: nothing in the left of the picture is at rest."""
    return threshold_evidence(limit_px / jnp.maximum(scene.uv[0], 1), scene.followed, jnp.zeros_like(limit_px))


def tracked(plan: TrackPlan, cue_params: tuple[Any, ...], people: int = 0) -> tuple[TrackState, TrackOutput]:
    """After some frames."""
    frames, given = stacked(clip(people).frames[:FRAMES]), params()._replace(cues=cue_params)
    state, output = new_state(), None
    for index in range(FRAMES):
        state, output = _step(state, at(frames, index), given, plan=plan)
    assert output is not None
    return state, output


class TestOwnCue:
    @pytest.mark.slow
    def test_has_a_veto(self) -> None:
        plan = PLAN._replace(cues=(left_of,))
        _, output = tracked(plan, (jnp.asarray(WIDTH / 2),))
        assert int(output.status) in (TrackStatus.OK, TrackStatus.WEAK)
        (verdict,), kept = output.cue_results, np.asarray(output.tracked)
        assert kept.sum() > 10
        assert (np.asarray(output.uv)[0, kept] > WIDTH / 2 - 2).all()
        assert set(np.asarray(verdict.weight)[np.asarray(verdict.known)].tolist()) == {0.0, 1.0}

    @pytest.mark.slow
    def test_that_would_lose_the_frame_is_not_heard(self) -> None:
        _, without = tracked(PLAN, ())
        _, output = tracked(PLAN._replace(cues=(left_of,)), (jnp.asarray(float(10 * WIDTH)),))
        assert int(output.status) == TrackStatus.OK
        np.testing.assert_allclose(output.T_world_cam.wxyz_xyz, without.T_world_cam.wxyz_xyz, atol=1e-6)
        assert not np.asarray(output.cue_results[0].weight)[np.asarray(output.cue_results[0].known)].any()

    @pytest.mark.slow
    def test_that_lets_all_pass_changes_nothing(self) -> None:
        _, without = tracked(PLAN, ())
        _, passed = tracked(PLAN._replace(cues=(left_of,)), (jnp.asarray(0.0),))
        np.testing.assert_allclose(passed.T_world_cam.wxyz_xyz, without.T_world_cam.wxyz_xyz, atol=1e-6)
        assert without.cue_results == ()

    @pytest.mark.slow
    def test_parameters_do_not_compile_anew(self) -> None:
        traces = 0

        def counted(scene: CueInput, limit_px: Any) -> CueResult:
            nonlocal traces
            traces += 1
            return left_of(scene, limit_px)

        for limit_px in (10.0, 20.0):
            tracked(PLAN._replace(cues=(counted,)), (jnp.asarray(limit_px),))
        assert traces == 1


class TestMaskedPoints:
    @pytest.mark.slow
    def test_cues_decide_where_masks_would(self) -> None:
        """The left half is masked; a cue finds its left quarter moving, and the points between are used."""
        frames, state, output = stacked(clip(0).frames[:FRAMES]), new_state(), None
        ignore = jnp.zeros_like(frames.ignore).at[..., : WIDTH // 2].set(True)
        given = params()._replace(cues=(jnp.asarray(WIDTH / 4),))
        for index in range(FRAMES):
            frame = at(frames._replace(ignore=ignore), index)
            state, output = _step(state, frame, given, plan=PLAN._replace(cues=(left_of,), judge_masked=True))
        assert output is not None
        assert int(output.status) == TrackStatus.OK
        column = np.asarray(output.uv)[0, np.asarray(output.tracked)]
        assert (column > WIDTH / 4 - 2).all()
        assert np.count_nonzero(column < WIDTH / 2 - 2) > 10


class TestWitnesses:
    def test_some_of_each_region_that_moves(self) -> None:
        """Old ones first; none where nothing moves, and none of the points that are left out for another reason."""
        num = 40
        of_point = np.repeat([0, 1, -1], [30, 8, 2])
        pixels = np.zeros((4, 40), bool)
        pixels[:, :34] = True  # the first region, and four points of the second
        regions = Regions(jnp.zeros((1, 1), int), jnp.asarray(of_point), jnp.zeros((3, 2)), jnp.ones(2, int))
        judged = DynamicRejection((), regions, moving=jnp.asarray(pixels))
        uv = jnp.stack([jnp.arange(num, dtype=float), jnp.ones(num)])
        age = jnp.asarray(np.where((np.arange(num) >= 20) & (np.arange(num) < 27), 3, 0))
        asked = jnp.ones(num, bool).at[30].set(False)
        chosen = np.flatnonzero(np.asarray(judged.monitor_points(uv, age, asked)))
        assert chosen.tolist() == [0, 1, 2, *range(20, 27), 31, 32, 33]
        assert not np.asarray(judged._replace(moving=None).monitor_points(uv, age, asked)).any()


class TestSettings:
    def test_by_name(self) -> None:
        config = load_config(overrides=["dynamics.cues=[trajectory]", "dynamics.trajectory.tolerance_m=0.05"]).dynamics
        (cue,), (chosen,) = with_cues(PLAN, config).cues, with_cue_params(params(), config).cues
        assert cue.__name__ == "trajectory_cue"
        assert float(chosen.tolerance_m) == pytest.approx(0.05)
        with pytest.raises(ConfigError, match="trajectry"):
            load_config(overrides=["dynamics.cues=[trajectry]"])

    @pytest.mark.slow
    def test_in_a_run(self) -> None:
        """With somebody walking through the room, and nothing else that would leave him out."""
        recording = clip(1)
        slam = Slam(
            recording.camera, Config(track=TRACK, dynamics=DynamicsConfig(cues=("trajectory",), balance_regions=False))
        )
        with slam:
            records = slam.run(recording)
        assert sum(record.status == TrackStatus.OK for record in records) > 0.9 * len(records)


class TestGradient:
    """By all parameters at once, as an optimizer takes them."""

    @pytest.mark.parametrize("preset", presets())
    def test_all_parameters_of_a_preset_have_one(self, preset: str) -> None:
        given = with_cue_params(params(), load_config(preset).dynamics)
        assert {leaf.dtype for leaf in jax.tree.leaves(given)} == {jnp.dtype(jnp.float32)}
        gradient = jax.grad(lambda p: sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(p)))(given)
        after = jax.tree.map(lambda a, b: a - 0.1 * b, given, gradient)
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), after, jax.tree.map(lambda a: 0.8 * a, given))

    @pytest.mark.slow
    def test_of_the_pose_equals_finite_differences(self) -> None:
        """With a temperature the pose has a derivative by limits of cues.

        With thresholds of 20 pixels, so that a cue alone decides what counts, the refinement takes more steps than the
        default plan has; derivatives were 1 % off.
        """
        config = DynamicsConfig(cues=("clusters", "trajectory"), temperature=0.3)
        plan = with_cues(PLAN.exact(), config)
        with jax.enable_x64(True):
            wide = {"ransac_px": jnp.asarray(20.0), "outlier_px": jnp.asarray(20.0)}
            given = with_cue_params(params(np.float64)._replace(**wide), config)
            frames = stacked(clip(2).frames[:FRAMES], np.float64, np.float64)
            state = init_state(HEIGHT, WIDTH, plan, image_dtype="float64", dtype="float64")
            step = quick_compile(track_step, static_argnames="plan")
            for index in range(FRAMES - 1):
                state, _ = step(state, at(frames, index), given, plan=plan)
            ahead = lambda p: track_step(state, at(frames, FRAMES - 1), p, plan)[1].T_world_cam.translation()[2]
            gradient = quick_compile(jax.grad(ahead))(given)
            jax.tree.map(lambda a, b: a - 0.1 * b, given, gradient)
            for name, where in BY.items():
                small = (1e-4 if name == "fx" else 3e-3) * where(given)  # by the camera the pose bends sooner
                changed = [eqx.tree_at(where, given, where(given) + sign * small) for sign in (1, -1)]
                outputs = [step(state, at(frames, FRAMES - 1), p, plan=plan)[1] for p in changed]
                assert [int(output.pose_status) for output in outputs] == [PoseStatus.OK] * 2
                more, less = (output.T_world_cam.translation()[2] for output in outputs)
                expected, slope = float((more - less) / (2 * small)), float(where(gradient))
                print(f"{name}: derivative {slope:.6e}, finite difference {expected:.6e}")
                assert abs(slope) > 0
                assert slope == pytest.approx(expected, rel=1e-5, abs=float(AT_OPTIMUM_M / small))
