"""Standard deviations of a calibration, from how much parts of the recording and places of the scene contradict."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import t as student_t

from jaxslam.calibration.batch_solve import BatchProblem, BatchSolution, shares_at
from jaxslam.calibration.parameters import CameraVector
from jaxslam.geometry.se3 import rotate

_POOLED = 10.0
"""Number of blocks from which on the ratio of one parameter counts more than that of all parameters."""
_PLACE = 0.25
"""Edge of the cubes in which points are one place, in typical distances from the camera."""
_NORMAL_TAIL = 0.97725
"""Probability below two standard deviations of a normal number."""


def standard_deviations(problem: BatchProblem, solution: BatchSolution, free: Bool[np.ndarray, " q"]) -> CameraVector:
    """Return the standard deviations of the parameters; 0 of one that is not free.

    The inverse Hessian alone is too small: the errors of a point along its track are alike, and those of neighbors too.
    Blocks of frames do not suffice either, as most of them see the same places, with the same errors of flow and depth
    there. So the fit is repeated, to first order, without each block and without each place in turn (the jackknife),
    and both variances are added, less that without each single point, which both contain. They are noisy for few
    blocks: the ratio of a variance to that of the inverse Hessian is mixed with the mean ratio of all parameters; two
    standard deviations are those of Student's distribution; and none is smaller than by the inverse Hessian.

    Source: Liang and Zeger, "Longitudinal Data Analysis Using Generalized Linear Models", 1986; Cameron, Gelbach and
    Miller, "Robust Inference with Multiway Clustering", 2011, who subtract what each place of each block adds, which is
    more; Bell and McCaffrey, "Bias Reduction in Standard Errors for Linear Regression with Multi-Stage Samples", 2002,
    for the jackknife.
    """
    sigmas = np.zeros(len(free))
    if not free.any():
        return sigmas
    # In units of the prior, in which the Hessian of the prior is the identity.
    scale = problem.prior_sigma[free]
    gradients, hessians = (np.concatenate(each) for each in zip(*shares_at(problem, solution, free), strict=True))
    gradients, hessians = gradients * scale, hessians * np.outer(scale, scale)
    num_blocks = len(problem.blocks)
    whole = hessians.sum(axis=0) + np.eye(len(scale))
    by_block = np.repeat(np.arange(num_blocks), [state.points.shape[1] for state in solution.states])
    parts = by_block, _places(problem, solution), np.arange(len(gradients))
    of_block, of_place, of_point = (_jackknife(gradients, hessians, whole, part) for part in parts)
    variance = np.maximum(of_block + of_place - of_point, np.maximum(of_block, of_place))
    by_model = np.diagonal(np.linalg.inv(whole))
    ratio = variance / by_model
    mixed = (num_blocks * ratio + _POOLED * ratio.mean()) / (num_blocks + _POOLED)
    few = student_t.ppf(_NORMAL_TAIL, num_blocks - 1) / 2
    sigmas[free] = scale * np.sqrt(np.maximum(few**2 * mixed, 1.0) * by_model)
    return sigmas


def _jackknife(
    gradients: Float[np.ndarray, "n k"],
    hessians: Float[np.ndarray, "n k k"],
    whole: Float[np.ndarray, "k k"],
    part: Int[np.ndarray, " n"],
) -> Float[np.ndarray, " k"]:
    """Return the variances by leaving out each part of the points in turn, one step from the optimum of all."""
    count = int(part.max()) + 1
    left_out, own = np.zeros((count, *whole.shape)), np.zeros((count, len(whole)))
    np.add.at(left_out, part, hessians)
    np.add.at(own, part, gradients)
    steps = np.linalg.solve(whole - left_out, own[..., None])[..., 0]
    return (count - 1) / count * np.square(steps - steps.mean(axis=0)).sum(axis=0)


def _places(problem: BatchProblem, solution: BatchSolution) -> Int[np.ndarray, " n"]:
    """Return the number of the place of each point of all blocks: a cube of the world."""
    points, distances = [], []
    for block, state in zip(problem.blocks, solution.states, strict=True):
        X_world = rotate(block.origin, state.points[:3].T)
        points.append(X_world + block.origin[4:])
        distances.append(np.linalg.norm(X_world, axis=1))  # the block begins at its origin
    edge = _PLACE * float(np.median(np.concatenate(distances)))
    cubes = np.floor(np.concatenate(points) / edge).astype(np.int64)
    return np.unique(cubes, axis=0, return_inverse=True)[1].ravel()
