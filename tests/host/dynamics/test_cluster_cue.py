"""Regions of a depth image, and the cue that judges them: what moves as a whole, known to a network or not."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cue_scenes import MOTIONS, N, check_finite, moves, scene
from jax.test_util import check_grads
from jaxslam_kernels.camera import make_intrinsics
from jaxslam_kernels.se3 import retract, to_camera
from quick_compile import quick_compile

from jaxslam.dynamics.cluster_cue import ClusterCue, ClusterParams, make_cluster_cue
from jaxslam.dynamics.cue import CueInput
from jaxslam.dynamics.regions import (
    RegionCueResult,
    RegionPlan,
    Regions,
    balance_regions,
    find_regions,
    lasting_weights,
    moving_pixels,
    no_regions,
    region_weights,
    remembered_weights,
)

HEIGHT, WIDTH = 118, 158
PLAN = RegionPlan(num_regions=6, step_px=4, num_steps=3)
INTRINSICS = (130.0, 130.0, 79.0, 59.0)


pytestmark = pytest.mark.usefixtures("float64")


def box_before_wall(shift_px: int = 0) -> np.ndarray:
    """Depth of a wall 3 m away and a box 1 m away in the left half of the picture."""
    depth = np.full((HEIGHT, WIDTH), 3.0)
    depth[30:90, 20 + shift_px : 60 + shift_px] = 1.0
    depth[:4] = 0
    return depth


_find_regions = quick_compile(find_regions, static_argnums=5)


def divided(depth: np.ndarray, before: Any = None, plan: RegionPlan = PLAN) -> Regions:
    intrinsics = make_intrinsics(*INTRINSICS, dtype=jnp.float64)
    X_cam = jnp.array([[-0.3, 0.9, 0.0, jnp.nan], [0.0, 0.1, 0.0, 0.0], [1.0, 3.0, 0.0, 1.0]])
    start = no_regions(plan, jnp.dtype(float)).centers if before is None else before
    return _find_regions(jax.random.key(1), jnp.asarray(depth), start, X_cam, intrinsics, plan)


class TestRegions:
    def test_a_frame_without_depth_keeps_the_centers(self) -> None:
        """Points are in the nearest region of before, and no pixel is in one."""
        before = divided(box_before_wall())
        found = divided(np.zeros((HEIGHT, WIDTH)), before.centers)
        np.testing.assert_array_equal(found.centers, before.centers)
        np.testing.assert_array_equal(found.of_point, before.of_point)
        assert (found.of_pixel == -1).all()
        np.testing.assert_array_equal(found.num_pixels > 0, before.num_pixels > 0)

    def test_no_depth_at_first(self) -> None:
        found = divided(np.zeros((HEIGHT, WIDTH)))
        assert (found.of_point == -1).all()
        assert not found.num_pixels.any()

    def test_no_region_holds_two_surfaces(self) -> None:
        found = divided(box_before_wall())
        rows, columns = (np.minimum(np.arange(0, size, 4) + 2, size - 1) for size in (HEIGHT, WIDTH))
        depth = box_before_wall()[rows][:, columns]
        label = np.asarray(found.of_pixel)
        assert label.shape == depth.shape
        assert (label[depth == 0] == -1).all()
        for region in range(PLAN.num_regions):
            held = depth[label == region]
            assert len(held) == 0 or min((held == 1).mean(), (held == 3).mean()) < 0.03, "but for a block at the edge"
        box, wall, none, unknown = np.asarray(found.of_point)
        assert np.median(depth[label == box]) == 1
        assert np.median(depth[label == wall]) == 3
        assert none == unknown == -1
        assert np.asarray(found.num_pixels).sum() == (depth > 0).sum()

    def test_go_on_from_the_last_frame(self) -> None:
        """A region keeps its number while its surface moves a little."""
        first = divided(box_before_wall())
        second = divided(box_before_wall(3), first.centers)
        assert int(first.of_point[0]) == int(second.of_point[0])
        assert float(jnp.linalg.norm(first.centers - second.centers)) < 0.3

    def test_without_depth_there_are_none(self) -> None:
        found = divided(np.zeros((HEIGHT, WIDTH)))
        assert (np.asarray(found.of_pixel) == -1).all()
        assert (np.asarray(found.of_point) == -1).all()
        again = divided(box_before_wall(), found.centers)
        assert np.asarray(again.num_pixels).sum() > 0

    def test_moving_pixels(self) -> None:
        found = divided(box_before_wall())
        box = int(found.of_point[0])
        half = jnp.ones(PLAN.num_regions).at[box].set(0.6)
        assert not np.asarray(moving_pixels(found, half, HEIGHT, WIDTH, PLAN)).any()
        moving = np.asarray(moving_pixels(found, jnp.square(half), HEIGHT, WIDTH, PLAN))  # 0.36
        assert moving.shape == (HEIGHT, WIDTH)
        assert moving.any()
        assert (box_before_wall()[moving] == 1).mean() > 0.9

    def test_verdicts_become_one(self) -> None:
        one, known = jnp.array([0.5, 1.0, 0.0]), jnp.array([True, True, True])
        verdicts = [RegionCueResult(one, jnp.zeros(3), known), RegionCueResult(jnp.array([0.5, 1.0, 1.0]), one, known)]
        assert region_weights(verdicts[:1]).tolist() == [0.5, 1.0, 0.0]
        assert region_weights(verdicts).tolist() == [0.25, 1.0, 0.0]

    def test_evidence_is_summed_up(self) -> None:
        """In limits beyond the limit; a little is given back in frames without; the rest stays as it is."""
        found = divided(box_before_wall())
        found = found._replace(num_pixels=jnp.array([9, 9, 9, 9, 0, 9]))
        known = jnp.array([True, True, True, False, True, True])
        first = RegionCueResult(jnp.ones(6), jnp.array([2.0, 0.9, 1.4, 9, 0, 9]), known)
        second = RegionCueResult(jnp.ones(6), jnp.array([1.5, 0.2, 1.6, 9, 0, 0]), known.at[3].set(False))
        before = jnp.array([1.0, 0.0, 0.6, 0.2, 0.0, 1.0])
        plan = PLAN._replace(recover_frames=5)
        weight = remembered_weights(found, [first, second], before, plan)
        assert weight.tolist() == pytest.approx([0.75, 0.1, 0.45, 0.2, 1, 0])
        at_rest = RegionCueResult(jnp.ones(6), jnp.full(6, 0.9), known)
        for _ in range(4):
            weight = remembered_weights(found, [at_rest], weight, plan)
        assert weight.tolist() == pytest.approx([1, 0.5, 0.85, 0.2, 1, 0.4])

    def test_what_proves_wrong_is_forgotten(self) -> None:
        """Where memory is against more than half of what agrees on a pose and is not said to move now."""
        of_point = jnp.array([0] * 6 + [1] * 4 + [2] * 9 + [-1])
        found = divided(box_before_wall())._replace(of_point=of_point, num_pixels=jnp.full(6, 9))
        evidence = jnp.array([0.0, 0.0, 3.0, 0, 0, 0])
        verdict = RegionCueResult((evidence <= 1).astype(float), evidence, jnp.ones(6, bool))
        last = lambda before, agreeing=True: lasting_weights(
            found, [verdict], jnp.array(before), jnp.full(20, agreeing), PLAN._replace(recover_frames=5)
        ).tolist()
        assert last([1.0, 0, 1, 1, 1, 1]) == pytest.approx([1, 0.1, 0.5, 1, 1, 1])
        assert last([0.0, 1, 0, 1, 1, 1]) == pytest.approx([1, 1, 0.5, 1, 1, 1])
        assert last([0.0, 1, 0, 1, 1, 1], False) == pytest.approx([0.1, 1, 0, 1, 1, 1])

    def test_even_votes(self) -> None:
        """Ten points on the box and two on the wall, of which one has half the weight; one in no region."""
        found = divided(box_before_wall())._replace(of_point=jnp.array([0] * 10 + [1, 2, -1]))
        weights = jnp.ones(13).at[11].set(0.5)
        votes = np.asarray(balance_regions(weights, found))
        assert votes[:10].sum() == pytest.approx(11.5 / PLAN.num_regions)
        assert votes[10:].tolist() == [1.0, 0.5, 1.0]


def in_regions(given: CueInput) -> CueInput:
    """With points that move and those at rest in regions of their own, 0 and 1; the last point in none."""
    label = jnp.where(jnp.asarray(moves()), 0, 1).at[-1].set(-1)
    return given._replace(regions=Regions(jnp.zeros((2, 2), int), label, jnp.zeros((3, 3)), jnp.ones(3, int)))


cluster_cue, published_cue = make_cluster_cue(), make_cluster_cue(as_published=True)


def params(**fields: Any) -> ClusterParams:
    plain = {"times_mean": 1.5, "least_px": 0.5, "robust_px": 2.45, "fewest": 3.0, "temperature": 0.0}
    return ClusterParams(**{name: jnp.array(value) for name, value in (plain | fields).items()})


class TestCue:
    @pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
    @pytest.mark.parametrize("cue", [cluster_cue, published_cue], ids=["corrected", "published"])
    def test_tells_the_region_that_moves(self, motion: Any, cue: ClusterCue) -> None:
        found = cue(in_regions(scene(motion, (0.15, 0, 0), noise_px=0.3)), params())
        expected = ~moves()
        expected[-1] = True  # in no region
        assert (np.asarray(found.weight) == expected).all()
        assert found.regions is not None
        assert found.regions.weight.tolist() == [0, 1, 1]
        assert found.regions.known.tolist() == [True, True, False]
        assert not bool(found.known[-1])

    def test_formula(self) -> None:
        """Equation 1, in NumPy, and the threshold."""
        given = in_regions(scene(MOTIONS["all"], (0.02, 0.01, 0), noise_px=0.5))
        X = np.asarray(to_camera(given.T_world_cam, given.X_anchor))
        k = given.intrinsics
        ideal = given._replace(intrinsics=k._replace(distortion=jnp.zeros(5)))
        uv = np.stack([float(k.fx) * X[0] / X[2] + float(k.cx), float(k.fy) * X[1] / X[2] + float(k.cy)])
        squared = ((uv - np.asarray(given.uv)) ** 2).sum(axis=0)
        robust = squared * 4 / (4 + squared)
        label = np.asarray(ideal.regions.of_point) if ideal.regions is not None else np.zeros(N)
        means = [robust[label == region].mean() for region in (0, 1)]
        found = published_cue(ideal, params(robust_px=2.0, least_px=0.0))
        assert found.regions is not None
        np.testing.assert_allclose(found.regions.evidence[:2], np.array(means) / (1.5 * robust.mean()), rtol=1e-9)

    def test_a_large_mover_does_not_hide_itself(self) -> None:
        """Of the mean over all points it is a large part: as published, two movers of which one is slow hide it."""
        given = in_regions(scene(MOTIONS["none"], (0.15, 0, 0), noise_px=0.2))
        assert given.regions is not None
        slow = np.arange(N) % 3 == 1
        regions = given.regions._replace(of_point=jnp.where(jnp.asarray(slow), 2, given.regions.of_point))
        given = given._replace(regions=regions, uv=given.uv.at[0].add(jnp.where(jnp.asarray(slow), 2.0, 0)))
        given = given._replace(agrees=given.agrees & ~jnp.asarray(slow))
        published, ours = (cue(given, params()).regions for cue in (published_cue, cluster_cue))
        assert published is not None
        assert ours is not None
        assert published.weight.tolist() == [0, 1, 1]
        assert ours.weight.tolist() == [0, 1, 0]

    def test_noise_is_no_motion(self) -> None:
        still = in_regions(scene(MOTIONS["all"], noise_px=0.2))
        assert (np.asarray(cluster_cue(still, params(times_mean=0.5)).weight) == 1).all()
        assert not (np.asarray(cluster_cue(still, params(times_mean=0.5, least_px=0.0)).weight) == 1).all()

    def test_few_points_say_nothing(self) -> None:
        given = in_regions(scene(MOTIONS["none"], (0.15, 0, 0)))
        found = cluster_cue(given._replace(followed=given.followed & (jnp.cumsum(jnp.asarray(moves())) < 3)), params())
        assert found.regions is not None
        assert found.regions.known.tolist() == [False, True, False]
        assert (np.asarray(found.weight) == 1).all()

    def test_bad_values(self) -> None:
        given = in_regions(scene(MOTIONS["all"], (0.15, 0, 0)))
        bad = given._replace(uv=given.uv.at[:, :5].set(jnp.nan), X_anchor=given.X_anchor.at[:, 5:9].set(jnp.inf))
        check_finite(lambda scene: cluster_cue(scene, params()), bad)
        nobody = given._replace(followed=jnp.zeros(N, bool))
        assert (np.asarray(cluster_cue(nobody, params(least_px=0.0)).weight) == 1).all()
        with pytest.raises(ValueError, match=r"TrackPlan\.regions"):
            cluster_cue(given._replace(regions=None), params())

    @pytest.mark.slow
    def test_gradient(self) -> None:
        """Of the weights by thresholds, pose and points."""
        given = in_regions(scene(MOTIONS["all"], (0.004, 0.002, 0), noise_px=0.6))

        def total(thresholds: Any, tangent: Any, uv: Any) -> Any:
            times_mean, robust_px = jnp.asarray(thresholds)
            pose = retract(given.T_world_cam, jnp.asarray(tangent))
            chosen = params(temperature=0.4, least_px=0.1)._replace(times_mean=times_mean, robust_px=robust_px)
            found = cluster_cue(given._replace(T_world_cam=pose, uv=jnp.asarray(uv)), chosen)
            return jnp.sum(found.weight * jnp.linspace(1, 2, N))

        arguments = jnp.array([1.5, 1.0]), jnp.full(6, 1e-3), given.uv
        check_finite(jax.jit(jax.grad(total, argnums=(0, 1, 2))), *arguments)
        check_grads(jax.jit(total), arguments, order=1, modes=("fwd", "rev"), rtol=1e-4, atol=1e-4, eps=1e-6)
