"""The epipolar cue: points off the lines of those at rest, and motions that determine no lines."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cue_scenes import MOTIONS, N, check_finite, moves, scene
from jaxslam_kernels.camera import project, undistort_pixels
from jaxslam_kernels.se3 import to_camera
from quick_compile import quick_compile

from jaxslam.dynamics.cue import CueInput
from jaxslam.dynamics.epipolar_cue import EpipolarParams, make_epipolar_cue

ASIDE: Any = (0.15, 0, 0)
MOTION: Any = (0.02, -0.08, 0.06, 0.01, 0.02, -0.01)
cue = jax.jit(make_epipolar_cue())


pytestmark = pytest.mark.usefixtures("float64")


def ideal(given: CueInput) -> CueInput:
    """As a camera without distortion sees it: lines are straight there."""
    k = given.intrinsics
    seen = {"uv_before": undistort_pixels(k, given.uv_before), "uv": undistort_pixels(k, given.uv)}
    return given._replace(intrinsics=k._replace(distortion=jnp.zeros(5)), **seen)


def inside(given: CueInput, border_px: float = 0.0) -> np.ndarray:
    """`(n,)` which points are in both pictures, off the border."""
    u, v = np.asarray(jnp.stack([given.uv_before, given.uv], axis=1))
    clear = (u >= border_px) & (u <= 639 - border_px) & (v >= border_px) & (v <= 479 - border_px)
    return clear.all(axis=0)


def params(**fields: Any) -> EpipolarParams:
    plain = {"limit_px": 1.0, "fewest_outside": 10.0, "border_px": 0.0, "ransac_px": 0.5, "temperature": 0.0}
    return EpipolarParams(**{name: jnp.array(value) for name, value in (plain | fields).items()})


class TestCue:
    @pytest.mark.parametrize("noise_px", [0.0, 0.1])
    def test_tells_what_leaves_its_line(self, noise_px: float) -> None:
        given = ideal(scene(MOTION, ASIDE, noise_px=noise_px))
        found = cue(given, params())
        assert (np.asarray(found.known) == inside(given)).all()
        assert (np.asarray(found.weight)[~moves()] == 1).all()
        assert (np.asarray(found.weight)[moves() & inside(given)] == 0).all()

    def test_along_its_line_nothing_is_seen(self) -> None:
        """Why the trajectory layer follows: the points go the way of the camera, twice as far."""
        aside = scene(MOTIONS["sideways"])
        way = aside.T_world_cam.translation() - aside.T_world_before.translation()
        given = ideal(scene(MOTIONS["sideways"], 2 * way))
        assert float(jnp.abs(given.uv - ideal(aside).uv)[0].max()) > 5
        found = cue(given, params())
        assert np.asarray(found.known).sum() > 0.8 * N
        assert (np.asarray(found.weight) == 1).all()

    @pytest.mark.parametrize("motion", ["none", "turning"])
    def test_motion_without_lines_is_no_evidence(self, motion: str) -> None:
        found = cue(ideal(scene(MOTIONS[motion], noise_px=0.1)), params())
        assert not np.asarray(found.known).any()
        assert (np.asarray(found.weight) == 1).all()

    def test_one_plane_is_no_evidence(self) -> None:
        given = ideal(scene(MOTION))
        X_cam = to_camera(given.T_world_before, given.X_world)
        on_plane = X_cam / X_cam[2:] * 2.0
        X_world = given.T_world_before.rotation().as_matrix() @ on_plane + given.T_world_before.translation()[:, None]
        rng = np.random.default_rng(0)
        seen = [
            project(given.intrinsics, to_camera(pose, X_world)) + 0.1 * rng.standard_normal((2, N))
            for pose in (given.T_world_before, given.T_world_cam)
        ]
        found = cue(given._replace(uv_before=seen[0], uv=seen[1]), params())
        assert not np.asarray(found.known).any()

    def test_masked_points_vote_only_if_there_are_few_others(self) -> None:
        """Under the mask is most of what is at rest; outside, what moves as one."""
        given = ideal(scene(MOTION, ASIDE))
        hidden = jnp.asarray(~moves())
        given = given._replace(followed=~hidden, masked=hidden)
        outside_votes, all_vote = (cue(given, params(fewest_outside=n)) for n in (10.0, 25.0))
        assert (np.asarray(all_vote.weight)[moves() & inside(given)] == 0).all()
        assert (np.asarray(all_vote.weight)[~moves()] == 1).all()
        assert not (np.asarray(outside_votes.weight)[moves() & inside(given)] == 0).any()

    def test_border_is_not_judged(self) -> None:
        given = ideal(scene(MOTION, ASIDE))
        found = cue(given, params(border_px=60.0))
        assert (np.asarray(found.known) == inside(given, 60.0)).all()
        assert inside(given, 60.0).sum() < inside(given).sum()

    def test_bad_values(self) -> None:
        given = ideal(scene(MOTION, ASIDE))
        bad = given._replace(uv=given.uv.at[:, :5].set(jnp.nan), followed=given.followed.at[5:9].set(False))
        found = cue(bad, params())
        check_finite(cue, bad, params())
        assert not np.asarray(found.known)[:9].any()
        nobody = given._replace(followed=jnp.zeros(N, bool))
        assert (np.asarray(cue(nobody, params()).weight) == 1).all()

    def test_same_function_for_the_same_number(self) -> None:
        assert make_epipolar_cue(64) is make_epipolar_cue(64)

    @pytest.mark.slow
    def test_gradient(self) -> None:
        """Of the weights by the limit and by where points are seen, with which the lines turn."""
        given = ideal(scene(MOTION, (0.01, 0.0, 0.0), noise_px=0.05))
        small = make_epipolar_cue(64)

        def total(limit_px: Any, uv: Any) -> Any:
            found = small(given._replace(uv=uv), params(temperature=0.4)._replace(limit_px=limit_px))
            return jnp.sum(found.weight * jnp.linspace(1, 2, N))

        at = quick_compile(jax.value_and_grad(total, argnums=(0, 1)))
        limit_px, step = jnp.array(1.0), 1e-6
        _, (by_limit, by_uv) = at(limit_px, given.uv)
        assert np.isfinite(by_uv).all()
        slope = (at(limit_px + step, given.uv)[0] - at(limit_px - step, given.uv)[0]) / (2 * step)
        assert float(by_limit) == pytest.approx(float(slope), rel=1e-4)
        way = jnp.asarray(np.random.default_rng(1).standard_normal((2, N)))
        slope = (at(limit_px, given.uv + step * way)[0] - at(limit_px, given.uv - step * way)[0]) / (2 * step)
        assert float(jnp.sum(by_uv * way)) == pytest.approx(float(slope), rel=1e-4)
