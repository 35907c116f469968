"""Cues in the tracker: by name in the settings, and a function of one's own, without a change to the package."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick_compile import quick_compile
from small_scene import PLAN, TRACK, WIDTH, at, clip, new_state, params, stacked

from jaxslam.config import Config, DynamicsConfig, load_config
from jaxslam.dynamics.cue import Scene, Verdict, judge
from jaxslam.dynamics.known import with_cue_params, with_cues
from jaxslam.dynamics.regions import Regions
from jaxslam.errors import ConfigError
from jaxslam.judging import Judged
from jaxslam.slam import Slam
from jaxslam.state import TrackOutput, TrackPlan, TrackState, TrackStatus
from jaxslam.track import track_step

FRAMES = 6
_step = quick_compile(track_step, static_argnames="plan")


def left_of(scene: Scene, limit_px: Any) -> Verdict:
    """One's own cue: nothing in the left of the picture is at rest."""
    return judge(limit_px / jnp.maximum(scene.uv[0], 1), scene.followed, jnp.zeros_like(limit_px))


def tracked(plan: TrackPlan, cue_params: tuple[Any, ...], people: int = 0) -> tuple[TrackState, TrackOutput]:
    """After some frames."""
    frames, given = stacked(clip(people).frames[:FRAMES]), params()._replace(cues=cue_params)
    state, output = new_state(), None
    for index in range(FRAMES):
        state, output = _step(state, at(frames, index), given, plan=plan)
    assert output is not None
    return state, output


class TestOwnCue:
    def test_has_a_veto(self) -> None:
        plan = PLAN._replace(cues=(left_of,))
        _, output = tracked(plan, (jnp.asarray(WIDTH / 2),))
        assert int(output.status) in (TrackStatus.OK, TrackStatus.WEAK)
        (verdict,), kept = output.verdicts, np.asarray(output.tracked)
        assert kept.sum() > 10
        assert (np.asarray(output.uv)[0, kept] > WIDTH / 2 - 2).all()
        assert set(np.asarray(verdict.weight)[np.asarray(verdict.known)].tolist()) == {0.0, 1.0}

    def test_that_would_lose_the_frame_is_not_heard(self) -> None:
        _, without = tracked(PLAN, ())
        _, output = tracked(PLAN._replace(cues=(left_of,)), (jnp.asarray(float(10 * WIDTH)),))
        assert int(output.status) == TrackStatus.OK
        np.testing.assert_allclose(output.T_world_cam.wxyz_xyz, without.T_world_cam.wxyz_xyz, atol=1e-6)
        assert not np.asarray(output.verdicts[0].weight)[np.asarray(output.verdicts[0].known)].any()

    def test_that_lets_all_pass_changes_nothing(self) -> None:
        _, without = tracked(PLAN, ())
        _, passed = tracked(PLAN._replace(cues=(left_of,)), (jnp.asarray(0.0),))
        np.testing.assert_allclose(passed.T_world_cam.wxyz_xyz, without.T_world_cam.wxyz_xyz, atol=1e-6)
        assert without.verdicts == ()

    def test_parameters_do_not_compile_anew(self) -> None:
        traces = 0

        def counted(scene: Scene, limit_px: Any) -> Verdict:
            nonlocal traces
            traces += 1
            return left_of(scene, limit_px)

        for limit_px in (10.0, 20.0):
            tracked(PLAN._replace(cues=(counted,)), (jnp.asarray(limit_px),))
        assert traces == 1


class TestWitnesses:
    def test_some_of_each_region_that_moves(self) -> None:
        """Old ones first; none where nothing moves, and none of the points that are left out for another reason."""
        num = 40
        of_point = np.repeat([0, 1, -1], [30, 8, 2])
        pixels = np.zeros((4, 40), bool)
        pixels[:, :34] = True  # the first region, and four points of the second
        regions = Regions(jnp.zeros((1, 1), int), jnp.asarray(of_point), jnp.zeros((3, 2)), jnp.ones(2, int))
        judged = Judged((), regions, moving=jnp.asarray(pixels))
        uv = jnp.stack([jnp.arange(num, dtype=float), jnp.ones(num)])
        age = jnp.asarray(np.where((np.arange(num) >= 20) & (np.arange(num) < 27), 3, 0))
        asked = jnp.ones(num, bool).at[30].set(False)
        chosen = np.flatnonzero(np.asarray(judged.witnesses(uv, age, asked)))
        assert chosen.tolist() == [0, 1, 2, *range(20, 27), 31, 32, 33]
        assert not np.asarray(judged._replace(moving=None).witnesses(uv, age, asked)).any()


class TestSettings:
    def test_by_name(self) -> None:
        config = load_config(overrides=["dynamics.cues=[trajectory]", "dynamics.trajectory.tolerance_m=0.05"]).dynamics
        (cue,), (chosen,) = with_cues(PLAN, config).cues, with_cue_params(params(), config).cues
        assert cue.__name__ == "trajectory_cue"
        assert float(chosen.tolerance_m) == pytest.approx(0.05)
        with pytest.raises(ConfigError, match="trajectry"):
            load_config(overrides=["dynamics.cues=[trajectry]"])

    def test_in_a_run(self) -> None:
        """With somebody walking through the room, and nothing else that would leave him out."""
        recording = clip(1)
        slam = Slam(
            recording.camera, Config(track=TRACK, dynamics=DynamicsConfig(cues=("trajectory",), even_votes=False))
        )
        with slam:
            records = slam.run(recording)
        assert sum(record.status == TrackStatus.OK for record in records) > 0.9 * len(records)

    def test_gradient_of_the_pose_by_a_tolerance(self) -> None:
        """With a temperature the pose has a derivative, equal to finite differences."""
        with jax.enable_x64(True):
            config = DynamicsConfig(cues=("trajectory",), even_votes=False, temperature=0.5)
            plan = with_cues(PLAN.exact(), config)
            frames, state = stacked(clip(1).frames[:FRAMES], np.float64, np.float64), new_state(np.float64, np.float64)
            given = with_cue_params(params(np.float64), config, np.float64)
            (chosen,) = given.cues
            step = quick_compile(track_step, static_argnames="plan")
            for index in range(FRAMES - 1):
                state, _ = step(state, at(frames, index), given, plan=plan)

            def ahead(tolerance_m: Any) -> Any:
                changed = given._replace(cues=(chosen._replace(tolerance_m=tolerance_m),))
                return track_step(state, at(frames, FRAMES - 1), changed, plan)[1].T_world_cam.translation()[2]

            at_m, step_m = jnp.asarray(0.02), 1e-4  # with 1e-5 the refinement stops a step earlier on one side
            slope = float(quick_compile(jax.grad(ahead))(at_m))
            value = quick_compile(ahead)
            difference = float(value(at_m + step_m) - value(at_m - step_m)) / (2 * step_m)
        assert abs(slope) > 0
        assert slope == pytest.approx(difference, rel=1e-3)
