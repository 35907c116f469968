"""Noise by maximum likelihood: Student's t-distribution, whose tails are as heavy as the residuals say.

The tracker's Cauchy loss gives a point the weight `c² / (c² + s)` of its squared residual `s`, a multivariate
t-distribution of `ν` degrees of freedom in `k` dimensions `(ν + k) / (ν + s / τ²)`: the loss is its likelihood, up to a
factor, with `c² = ν τ²`. As in the loss, pixel and depth of a point are one residual, good or bad together.

Source: Lange, Little and Taylor, "Robust Statistical Modeling Using the t Distribution", 1989.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from scipy.special import gammaln

from jaxslam.calibration.noise_recorder import PointResiduals

_FREEDOM_OF_POINTS, _FREEDOM_OF_MOTIONS = (1.0, 100.0), (4.0, 100.0)
"""Limits of the degrees of freedom: at 100 it is about a normal distribution. Of motions, the covariance is wanted:
with 4 or fewer the fourth moment is infinite, and the largest of a few hundred motions would decide."""
_LEAST, _MOST = 1e-4, 1e4
"""Limits of what is estimated, in the units of the start."""


class PointNoise(NamedTuple):
    """Noise of single points.

    Attributes:
        pixel: Standard deviation of a pixel, each coordinate, pixels.
        depth: Standard deviation of a depth, as a factor of that in the settings; NaN without any depth.
        freedom: Degrees of freedom of the t-distribution: the smaller, the heavier its tails.
    """

    pixel: float
    depth: float
    freedom: float


class MotionNoise(NamedTuple):
    """Errors of motions beside the covariances that were given out.

    Attributes:
        factor: Ratio of the true standard deviations to those given out.
        freedom: Degrees of freedom of the t-distribution.
    """

    factor: float
    freedom: float


def point_log_likelihood(residuals: PointResiduals, noise: PointNoise) -> Float[np.ndarray, " n"]:
    """Return the log-likelihood of the residuals of each point."""
    measured = np.isfinite(residuals.depth)
    depth = np.where(measured, residuals.depth, 0.0) / (noise.depth if measured.any() else 1.0)
    squared = np.sum((residuals.pixel / noise.pixel) ** 2, axis=0) + depth**2
    log_root = 2 * np.log(noise.pixel) + np.where(measured, np.log(noise.depth) if measured.any() else 0.0, 0.0)
    return _log_density(squared, np.where(measured, 3, 2), noise.freedom) - log_root


def fit_points(residuals: PointResiduals) -> PointNoise:
    """Fit the noise of single points.

    Args:
        residuals: Residuals of at least one point.
    """
    has_depth = bool(np.isfinite(residuals.depth).any())

    def noise_of(numbers: np.ndarray) -> PointNoise:
        pixel, freedom, depth = np.exp(numbers)
        return PointNoise(float(pixel), float(depth) if has_depth else np.nan, float(freedom))

    first = np.log([_typical(residuals.pixel), 5.0, _typical(residuals.depth)])
    limits = np.log([(_LEAST, _MOST), _FREEDOM_OF_POINTS, (_LEAST, _MOST)])
    cost = lambda numbers: -float(point_log_likelihood(residuals, noise_of(numbers)).mean())
    return noise_of(minimize(cost, first, bounds=limits, method="L-BFGS-B").x)


def motion_log_likelihood(normalized: Float[np.ndarray, " n"], noise: MotionNoise) -> Float[np.ndarray, " n"]:
    """Return the log-likelihood of each motion, up to the determinant of its own covariance.

    Args:
        normalized: `(n,)` squared errors in units of the covariances that were given out, of 6 degrees of freedom.
        noise: What is assumed: the covariance of the t-distribution is `factor²` times that given out.
    """
    scale = noise.factor**2 * (noise.freedom - 2) / noise.freedom
    return _log_density(normalized / scale, np.full(normalized.shape, 6), noise.freedom) - 3 * np.log(scale)


def fit_motions(normalized: Float[np.ndarray, " n"], *, factor: float | None = None) -> MotionNoise:
    """Fit the ratio of the true standard deviations of motions to those given out.

    Args:
        normalized: See `motion_log_likelihood`; at least one.
        factor: The ratio, if only the degrees of freedom are to be fitted.
    """

    def noise_of(numbers: np.ndarray) -> MotionNoise:
        return MotionNoise(float(np.exp(numbers[1])) if factor is None else factor, float(np.exp(numbers[0])))

    first = [np.log(5.0), np.log(_typical(np.sqrt(normalized / 6)))]
    limits = [np.log(_FREEDOM_OF_MOTIONS), np.log([_LEAST, _MOST])]
    size = 2 if factor is None else 1
    cost = lambda numbers: -float(motion_log_likelihood(normalized, noise_of(numbers)).mean())
    return noise_of(minimize(cost, first[:size], bounds=limits[:size], method="L-BFGS-B").x)


def _typical(values: np.ndarray) -> float:
    """A standard deviation to begin with, by the median; 1 without values."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.clip(1.4826 * np.median(known), 10 * _LEAST, _MOST / 10)) if len(known) else 1.0


def _log_density(squared: np.ndarray, dimensions: np.ndarray, freedom: float) -> np.ndarray:
    """Log-density of a standard multivariate t-distribution."""
    constant = gammaln((freedom + dimensions) / 2) - gammaln(freedom / 2) - dimensions / 2 * np.log(freedom * np.pi)
    return constant - (freedom + dimensions) / 2 * np.log1p(squared / freedom)


def halves(times: Int[np.ndarray, " n"], num_parts: int) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Cut samples into parts of a recording, every other one of which is in one half.

    Args:
        times: `(n,)` times or numbers of their frames.
        num_parts: Number of parts.

    Returns:
        `(n,)` number of the part of each sample, and `(n,)` whether it is in the first half.
    """
    begin, end = int(times.min()), int(times.max())
    part = np.minimum((times - begin) * num_parts // max(end - begin, 1), num_parts - 1)
    return part, part % 2 == 0
