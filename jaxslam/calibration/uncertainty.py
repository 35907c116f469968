"""Standard deviations of a calibration, from how much blocks of frames contradict each other."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.calibration.batch_solve import BatchProblem, BatchSolution, reduced_at
from jaxslam.calibration.elimination import Reduced
from jaxslam.calibration.parameters import CameraVector

_POOLED = 10.0
"""Number of blocks that the ratio of one parameter must have for it to count as much as that of all parameters."""


def standard_deviations(problem: BatchProblem, solution: BatchSolution, free: Bool[np.ndarray, " q"]) -> CameraVector:
    """Return the standard deviations of the parameters; 0 of one that is not free.

    The inverse Hessian alone is too small: the errors of a point along its track are alike, and those of neighbors too.
    Blocks share neither. So the spread of their gradients at the optimum gives the true variance (the sandwich
    estimator), which is noisy for few blocks: its ratio to that of the inverse Hessian is mixed with the mean ratio of
    all parameters, and not below one.

    Source: Huber, "The Behavior of Maximum Likelihood Estimates under Nonstandard Conditions", 1967; Liang and Zeger,
    "Longitudinal Data Analysis Using Generalized Linear Models", 1986.
    """
    sigmas = np.zeros(len(free))
    if free.any():
        blocks = reduced_at(problem, solution, free)
        sigmas[free] = _of_blocks(blocks, problem.prior_sigma[free])
    return sigmas


def _of_blocks(blocks: Sequence[Reduced], prior_sigma: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    # In units of the prior, in which the Hessian of the prior is the identity.
    scale = prior_sigma
    hessian = sum((each.hessian for each in blocks), np.zeros((len(scale), len(scale)))) * np.outer(scale, scale)
    inverse = np.linalg.inv(hessian + np.eye(len(scale)))
    gradients = np.stack([each.gradient for each in blocks]) * scale
    gradients = gradients - gradients.mean(axis=0)
    num_blocks = len(blocks)
    spread = gradients.T @ gradients * num_blocks / (num_blocks - 1) + np.eye(len(scale))
    by_model, by_spread = np.diagonal(inverse), np.diagonal(inverse @ spread @ inverse)
    ratio = by_spread / by_model
    pooled = np.trace(inverse @ spread) / len(scale)
    mixed = (num_blocks * ratio + _POOLED * pooled) / (num_blocks + _POOLED)
    return scale * np.sqrt(np.maximum(mixed, 1.0) * by_model)
