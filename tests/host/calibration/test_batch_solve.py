"""The core of calibration on simulated tracks: derivatives, recovery, standard deviations, and the gate."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_tracks import CAMERA, Simulation, simulate_blocks, true_vector

from jaxslam.calibration.batch_solve import (
    BatchProblem,
    BatchSolution,
    estimated_noise,
    first_states,
    shares_at,
    solve_batch,
    with_depth_looked_up,
)
from jaxslam.calibration.elimination import Noise, reduce_block, weighted
from jaxslam.calibration.gating import gate
from jaxslam.calibration.parameters import DEPTH_OFFSET, FOCAL, GROUPS, PARAMETERS, READOUT, group_mask, prior_sigmas
from jaxslam.calibration.residuals import NUM_POINT, NUM_POSE, linearize, residuals_of
from jaxslam.calibration.uncertainty import standard_deviations
from jaxslam.errors import DatasetError
from jaxslam.geometry.se3 import retract

TRUTH = true_vector()
START = TRUTH * np.array([1.05, 1.05, *15 * [1.0]])
ALL = group_mask(GROUPS)
SETTINGS = {"height": CAMERA.height}


def problem(start: np.ndarray = START, truth: np.ndarray = TRUTH, seed: int = 0) -> BatchProblem:
    blocks = simulate_blocks(Simulation(truth, seed=seed), num_blocks=10, num_frames=12)
    return BatchProblem(blocks, start, prior_sigmas(CAMERA), CAMERA.height, Noise(0.3, 1.0, 1.0))


def solved(given: BatchProblem, free: np.ndarray = ALL) -> tuple[BatchProblem, BatchSolution]:
    first = solve_batch(given, given.prior, first_states(given.blocks), free)
    again = replace(given, noise=estimated_noise(given, first))
    return again, solve_batch(again, first.camera, first.states, free)


@pytest.fixture(scope="module")
def fitted() -> tuple[BatchProblem, BatchSolution]:
    return solved(problem())


@pytest.mark.slow
def test_derivatives_are_those_of_differences() -> None:
    block, rng = problem().blocks[0], np.random.default_rng(0)
    start = first_states([block])[0].points
    at_start = linearize(block, block.poses, start, START, **SETTINGS)
    camera = 1e-2 * rng.normal(size=17) * prior_sigmas(CAMERA)
    poses, points = 1e-3 * rng.normal(size=(len(block.poses), 6)), 1e-3 * rng.normal(size=start.shape)
    moved = np.stack([retract(pose, step) for pose, step in zip(block.poses, poses, strict=True)])
    later, _ = residuals_of(block, moved, start + points, START + camera, **SETTINGS)
    last = block.num_frames - 1
    around = np.clip(np.arange(block.num_frames)[:, None] + np.array([-1, 0, 1]), 0, last)
    by_pose = np.einsum("fkpt,ft->fkp", at_start.jacobian[..., :NUM_POSE], poses[around].reshape(-1, NUM_POSE))
    by_point = np.einsum("fkpx,xp->fkp", at_start.jacobian[..., NUM_POSE : NUM_POSE + NUM_POINT], points)
    by_camera = at_start.jacobian[..., NUM_POSE + NUM_POINT :] @ camera
    expected, seen = by_pose + by_point + by_camera, block.seen
    for residual in range(3):
        change = (later - at_start.residuals)[:, residual][seen]
        np.testing.assert_allclose(change, expected[:, residual][seen], atol=0.03 * np.abs(change).max())


def test_all_parameters_are_found(fitted: tuple[BatchProblem, BatchSolution]) -> None:
    noisy, solution = fitted
    sigmas = standard_deviations(noisy, solution, ALL)
    assert solution.converged
    errors = np.abs(solution.camera - TRUTH)
    assert (errors[:2] < 0.006 * TRUTH[:2]).all()
    assert errors[9] < 0.02
    assert (errors[[10, 11]] < 2e-3).all()
    assert (errors < 4 * sigmas).all()
    assert (sigmas < 0.5 * noisy.prior_sigma).all()


def test_points_share_the_reduced_equations(fitted: tuple[BatchProblem, BatchSolution]) -> None:
    noisy, solution = fitted
    block, state = noisy.blocks[0], solution.states[0]
    linear = linearize(block, *state, solution.camera, **SETTINGS)
    parts = weighted(block, state.points, linear.residuals, noisy.noise)
    reduced = reduce_block(linear, parts, noisy.noise, ALL, 0.0)
    gradients, hessians = shares_at(noisy, solution, ALL)[0]
    gradients, hessians = gradients * noisy.prior_sigma, hessians * np.outer(noisy.prior_sigma, noisy.prior_sigma)
    whole = reduced.hessian * np.outer(noisy.prior_sigma, noisy.prior_sigma)
    np.testing.assert_allclose(hessians.sum(axis=0), whole, atol=1e-5 * np.abs(whole).max())
    # The poses are at their optimum, where what all points say of them cancels.
    spread = np.abs(gradients).sum(axis=0)
    assert (np.abs(gradients.sum(axis=0) - reduced.gradient * noisy.prior_sigma) < 0.02 * spread).all()


def test_noise_is_found(fitted: tuple[BatchProblem, BatchSolution]) -> None:
    noisy, _ = fitted
    assert noisy.noise.pixel == pytest.approx(0.2, rel=0.1)
    assert noisy.noise.depth == pytest.approx(0.5, rel=0.15)  # the simulation states twice its noise


@pytest.mark.slow
def test_what_the_depths_of_a_point_share_is_found() -> None:
    """Shared errors of twice the single ones are told from those, and fewer of them make the offset surer."""
    rng, given = np.random.default_rng(5), problem(TRUTH)
    blocks = []
    for block in given.blocks:
        plane = block.depth.plane.copy()
        plane[:, 0] += 0.004 * rng.normal(size=plane.shape[-1])
        blocks.append(block._replace(depth=block.depth._replace(plane=plane)))
    alike, solution = solved(replace(given, blocks=blocks))
    for _ in range(3):
        alike = replace(alike, noise=estimated_noise(alike, solution))
        solution = solve_batch(alike, solution.camera, solution.states, ALL)
    assert alike.noise.depth == pytest.approx(0.5, rel=0.15)
    assert alike.noise.shared == pytest.approx(1.0, rel=0.15)  # the simulation states a deviation of 0.004


def test_what_is_not_free_stays(fitted: tuple[BatchProblem, BatchSolution]) -> None:
    noisy, solution = fitted
    only = solve_batch(noisy, START, solution.states, group_mask((FOCAL,)), max_steps=3)
    changed = only.camera != START
    assert {PARAMETERS[index].name for index in np.flatnonzero(changed)} == {"fx", "fy"}
    nothing = solve_batch(noisy, START, solution.states, np.zeros(17, bool), max_steps=3)
    np.testing.assert_array_equal(nothing.camera, START)
    assert nothing.costs.sum() > solution.costs.sum()


def test_no_residual_knows_the_scale() -> None:
    """A larger world with larger depths gives the same residuals: the scale is unobservable."""
    block, factor = problem().blocks[0], 1.7
    poses, camera = block.poses.copy(), TRUTH.copy()
    poses[:, 4:] *= factor
    camera[[9, 15, 16]] *= factor
    depth = block.depth._replace(plane=block.depth.plane / factor, sigma=block.depth.sigma / factor)
    points = first_states([block])[0].points
    larger, _ = residuals_of(block._replace(depth=depth), poses, factor * points, camera, **SETTINGS)
    same, _ = residuals_of(block, block.poses, points, TRUTH, **SETTINGS)
    seen = np.moveaxis(np.broadcast_to(block.seen, (3, *block.seen.shape)), 0, 1)
    np.testing.assert_allclose(larger[seen], same[seen], atol=2e-3)


@pytest.mark.slow
def test_gate_takes_what_is_wrong_and_leaves_what_is_right() -> None:
    truth = TRUTH.copy()
    truth[11] = 0.0  # a global shutter, as the start says
    start = truth.copy()
    start[:2] *= 1.05
    start[9] -= 0.1
    noisy, solution = solved(problem(start, truth))
    steps: list[str] = []
    result = gate(noisy, start, solution, (FOCAL, DEPTH_OFFSET, READOUT), steps.append)
    assert FOCAL in result.accepted
    assert READOUT not in result.accepted
    assert result.after.costs.sum() < result.before.costs.sum()
    assert result.gains[FOCAL] > 0
    assert steps[0].startswith("held-out frames")


def test_derivatives_that_are_not_finite_are_told(fitted: tuple[BatchProblem, BatchSolution]) -> None:
    block, state = fitted[0].blocks[0], fitted[1].states[0]
    seen, points = block.seen.copy(), state.points.copy()
    seen[:, 0], points[:, 0] = False, np.nan
    block = block._replace(seen=seen)
    linearize(block, state.poses, points, TRUTH, **SETTINGS)
    points[:, 1] = np.nan
    with pytest.raises(DatasetError, match=r"expected finite derivatives of .* in its frames"):
        linearize(block, state.poses, points, TRUTH, **SETTINGS)


def test_depth_needs_settings_to_be_looked_up(fitted: tuple[BatchProblem, BatchSolution]) -> None:
    with pytest.raises(ValueError, match=r"problem\.depth"):
        with_depth_looked_up(*fitted)


@pytest.mark.slow
def test_standard_deviations_are_honest() -> None:
    """Of errors in twelve simulations, 88 to 99 % are within two standard deviations."""
    errors = []
    for seed in range(12):
        noisy, solution = solved(problem(seed=seed))
        errors.append((solution.camera - TRUTH) / standard_deviations(noisy, solution, ALL))
    assert 0.88 <= float((np.abs(errors) < 2).mean()) <= 0.99
