"""Cues to what moves: limits, their smooth forms, derivatives; each cue on points at rest and points that move."""

from typing import Any, cast, get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cue_scenes import MOTIONS, N, check_finite, moves, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxslam_kernels.se3 import retract, to_camera, to_world

from jaxslam.config.schema import DynamicsConfig
from jaxslam.dynamics.cue import CueResult, combine_cues, threshold_evidence
from jaxslam.dynamics.occlusion import PointState, next_states, occluded_share, occlusion_weights
from jaxslam.dynamics.scene_flow_cue import TrajectoryParams, trajectory_cue
from jaxslam.tracking.cue_registry import _known

EVIDENCE = st.lists(st.floats(0, 100, width=32), min_size=1, max_size=20)


pytestmark = pytest.mark.usefixtures("float64")


def params(*, as_published: bool = False, temperature: float = 0.0) -> TrajectoryParams:
    return TrajectoryParams(jnp.array(0.01), jnp.array(0.01), jnp.array(float(as_published)), jnp.array(temperature))


class TestJudge:
    def test_by_the_limit(self) -> None:
        found = threshold_evidence(
            jnp.array([0.0, 1.0, 1.001, 5.0, jnp.nan, jnp.inf]), jnp.ones(6, bool), jnp.array(0.0)
        )
        assert found.weight.tolist() == [1, 1, 0, 0, 1, 1]
        assert found.known.tolist() == [True] * 4 + [False] * 2
        assert found.evidence.tolist() == pytest.approx([0, 1, 1.001, 5, 0, 0])

    def test_nothing_known(self) -> None:
        found = threshold_evidence(jnp.array([5.0, 5.0]), jnp.zeros(2, bool), jnp.array(0.3))
        assert found.weight.tolist() == [1, 1]

    @given(EVIDENCE)
    @settings(deadline=None, max_examples=30)
    def test_smooth_becomes_the_limit(self, evidence: list[float]) -> None:
        """Whatever is not at the limit itself, where the smooth one is one half."""
        values = jnp.asarray(evidence, float)
        away, known = np.abs(np.asarray(values) - 1) > 1e-3, jnp.ones(len(evidence), bool)
        hard, soft = (np.asarray(threshold_evidence(values, known, jnp.array(t)).weight) for t in (0.0, 1e-5))
        np.testing.assert_allclose(soft[away], hard[away], atol=1e-12)
        assert threshold_evidence(jnp.ones(1), jnp.ones(1, bool), jnp.array(0.5)).weight.tolist() == [0.5]

    def test_every_cue_has_a_veto(self) -> None:
        made = [CueResult(jnp.array(w), jnp.zeros(3), jnp.ones(3, bool)) for w in ([1.0, 0.0, 0.5], [1.0, 1.0, 0.5])]
        assert combine_cues(made, jnp.array([1.0, 1.0, 0.8])).tolist() == pytest.approx([1.0, 0.0, 0.2])
        assert combine_cues([], jnp.array([0.5])).tolist() == [0.5]


class TestTrajectory:
    @pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
    @pytest.mark.parametrize("moved_m", [(0.15, 0, 0), (0, -0.15, 0.1), (0.05, 0, -0.15)])
    def test_tells_what_moves(self, motion: Any, moved_m: Any) -> None:
        found = trajectory_cue(scene(motion, moved_m), params())
        assert (np.asarray(found.weight) == ~moves()).all()
        np.testing.assert_allclose(np.asarray(found.evidence)[~moves()], 0, atol=1e-9)

    def test_as_published_is_wrong_where_the_camera_turns(self) -> None:
        """And for what goes along with the camera: here the corrected form is right, and there too."""
        turning = scene(MOTIONS["turning"])
        assert (np.asarray(trajectory_cue(turning, params(as_published=True)).weight) == 0).mean() > 0.5
        assert (np.asarray(trajectory_cue(turning, params()).weight) == 1).all()
        aside = scene(MOTIONS["sideways"])
        ends = np.asarray(to_world(aside.T_world_before, jnp.array([[0.0, 0.1], [0.0, 0.0], [0.0, 0.0]])))
        both = scene(MOTIONS["sideways"], ends[:, 1] - ends[:, 0])
        assert (np.asarray(trajectory_cue(both, params(as_published=True)).weight)[moves()] == 1).all()
        assert (np.asarray(trajectory_cue(both, params()).weight)[moves()] == 0).all()

    def test_as_published(self) -> None:
        """The formula, in NumPy."""
        given = scene(MOTIONS["all"], (0.15, 0, 0))
        before = np.asarray(to_camera(given.T_world_before, given.X_world))
        shift = np.where(moves()[None, :], np.array([[0.15], [0], [0]]), 0)
        now = np.asarray(to_camera(given.T_world_cam, given.X_world + shift))
        camera_m = np.linalg.norm(given.T_world_cam.translation() - given.T_world_before.translation())
        apart = np.abs(np.linalg.norm(now - before, axis=0) - camera_m)
        expected = apart / (0.01 + 0.01 * np.minimum(before[2], now[2]))
        found = trajectory_cue(given, params(as_published=True))
        np.testing.assert_allclose(found.evidence, expected, rtol=1e-6, atol=1e-9)

    def test_without_depth_nothing_is_said(self) -> None:
        given = scene(MOTIONS["all"], (0.15, 0, 0))
        bad = given._replace(
            depth=given.depth.at[:20].set(0), depth_before=given.depth_before.at[20:30].set(jnp.nan),
            uv=given.uv.at[:, 30:40].set(jnp.nan), followed=given.followed.at[40:50].set(False),
        )  # fmt: skip
        found = trajectory_cue(bad, params())
        assert not np.asarray(found.known)[:50].any()
        assert (np.asarray(found.weight)[:50] == 1).all()
        assert np.isfinite(np.asarray(found.evidence)).all()

    @pytest.mark.slow
    @pytest.mark.parametrize("as_published", [False, True])
    @pytest.mark.parametrize("motion", ["none", "all"])
    def test_gradient(self, as_published: bool, motion: str) -> None:
        """Of the weights by the tolerances, the pose and the points, at rest too."""
        given = scene(MOTIONS[motion], (0.02, 0.01, 0))

        def total(tolerances: Any, tangent: Any, depth: Any) -> Any:
            pose = retract(given.T_world_cam, jnp.asarray(tangent))
            changed = given._replace(T_world_cam=pose, depth=depth)
            chosen = params(as_published=as_published, temperature=0.3)
            near, per_m = jnp.asarray(tolerances)
            chosen = chosen._replace(tolerance_m=near, tolerance_per_m=per_m)
            return jnp.sum(trajectory_cue(changed, chosen).weight * jnp.linspace(1, 2, N))

        arguments = jnp.array([0.01, 0.01]), jnp.full(6, 1e-3), given.depth
        check_finite(jax.grad(total, argnums=(0, 1, 2)), *arguments)
        if motion == "all":  # at rest the length of a way has a corner
            check_grads(total, arguments, order=1, modes=("fwd", "rev"), rtol=1e-4, atol=1e-4, eps=1e-6)


class TestOcclusion:
    """A point that a person passes before, in the order of the frames."""

    @staticmethod
    def after(*frames: tuple[bool, bool, bool]) -> PointState:
        """Of a point for which each frame says: inside the picture, under the mask, displaced."""
        states = jnp.array([PointState.STATIC])
        for frame in frames:
            states = next_states(states, *(jnp.array([flag]) for flag in frame))
        return PointState(int(states[0]))

    SEEN, UNDER = (True, False, False), (True, True, False)
    OUTSIDE, ELSEWHERE = (False, False, False), (True, False, True)

    def test_states(self) -> None:
        assert self.after(self.SEEN, self.SEEN) == PointState.STATIC
        assert self.after(self.SEEN, self.UNDER) == PointState.BLOCKED
        assert self.after(self.SEEN, self.UNDER, self.UNDER, self.SEEN) == PointState.OCCLUDED
        assert self.after(self.UNDER, self.OUTSIDE) == PointState.BLOCKED
        assert self.after(self.UNDER, self.OUTSIDE, self.SEEN) == PointState.OCCLUDED
        assert self.after(self.UNDER, self.SEEN, self.UNDER, self.OUTSIDE) == PointState.OCCLUDED
        assert self.after((False, True, False)) == PointState.STATIC

    def test_guard(self) -> None:
        """What is carried away later is as any other point again, and may be passed again."""
        assert self.after(self.UNDER, self.SEEN, self.ELSEWHERE) == PointState.STATIC
        assert self.after(self.UNDER, self.ELSEWHERE) == PointState.STATIC
        assert self.after(self.UNDER, self.SEEN, (False, False, True)) == PointState.OCCLUDED
        assert self.after(self.UNDER, self.SEEN, self.ELSEWHERE, self.UNDER, self.SEEN) == PointState.OCCLUDED

    def test_weights(self) -> None:
        states = jnp.array([0, 1, 2, 2])
        assert occlusion_weights(states, jnp.array(3.0)).tolist() == [1, 1, 3, 3]
        total = lambda weight: jnp.sum(occlusion_weights(states, weight))
        assert float(jax.grad(total)(jnp.array(3.0))) == 2
        assert float(occluded_share(states, jnp.array([True, True, True, False]))) == pytest.approx(1 / 3)
        assert float(occluded_share(states, jnp.zeros(4, bool))) == 0


def test_every_cue_of_the_settings_is_found() -> None:
    """The names that `dynamics.cues` accepts are those of the modules `..._cue.py`, each with its section."""
    (names, _) = get_args(get_type_hints(DynamicsConfig)["cues"])
    assert set(get_args(names)) == set(_known())
    for name, cue in _known().items():
        section, params_class = getattr(DynamicsConfig(), name), cast(Any, cue.params)
        assert callable(cue.make(section))
        if cue.read_params is None:
            assert {field for field in params_class._fields if field != "temperature"} <= vars(section).keys()
