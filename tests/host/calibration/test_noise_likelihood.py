"""Noise from samples of known distributions."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_t

from jaxslam.calibration.noise_likelihood import (
    MotionNoise,
    PointNoise,
    fit_motions,
    fit_points,
    halves,
    motion_log_likelihood,
    point_log_likelihood,
)
from jaxslam.calibration.noise_recorder import PointResiduals

REFERENCE: Any = multivariate_t
TRUE = PointNoise(pixel=0.3, depth=0.5, freedom=5.0)


def _residuals(n: int = 6000, *, with_depth: float = 0.7, seed: int = 0) -> PointResiduals:
    rng = np.random.default_rng(seed)
    heavy = np.sqrt(TRUE.freedom / rng.chisquare(TRUE.freedom, n))
    depth = np.where(rng.uniform(size=n) < with_depth, TRUE.depth * heavy * rng.normal(size=n), np.nan)
    return PointResiduals(np.arange(n), TRUE.pixel * heavy * rng.normal(size=(2, n)), depth)


def _motions(factor: float, n: int = 2000) -> np.ndarray:
    return factor**2 * np.random.default_rng(1).chisquare(6, n)


def test_likelihood_of_points_is_that_of_the_t_distribution() -> None:
    residuals = _residuals(50)
    shape = np.diag([TRUE.pixel**2, TRUE.pixel**2, TRUE.depth**2])
    rows = np.concatenate([residuals.pixel, residuals.depth[None]]).T
    size = np.where(np.isfinite(residuals.depth), 3, 2)
    expected = [
        REFERENCE.logpdf(row[:k], shape=shape[:k, :k], df=TRUE.freedom) for row, k in zip(rows, size, strict=True)
    ]
    np.testing.assert_allclose(point_log_likelihood(residuals, TRUE), expected, rtol=1e-9)


def test_likelihood_of_motions_is_that_of_the_t_distribution() -> None:
    errors = np.random.default_rng(2).normal(size=(20, 6))
    noise = MotionNoise(factor=1.7, freedom=7.0)
    shape = noise.factor**2 * (noise.freedom - 2) / noise.freedom * np.eye(6)
    expected = REFERENCE.logpdf(errors, shape=shape, df=noise.freedom)
    np.testing.assert_allclose(motion_log_likelihood(np.sum(errors**2, axis=1), noise), expected, rtol=1e-9)


def test_noise_of_points_is_found() -> None:
    found = fit_points(_residuals())
    np.testing.assert_allclose(found[:2], TRUE[:2], rtol=0.05)
    assert found.freedom == pytest.approx(TRUE.freedom, rel=0.2)


def test_one_point_in_ten_that_is_far_off_changes_little() -> None:
    residuals = _residuals()
    pixel = residuals.pixel.copy()
    pixel[:, ::10] += 30.0
    np.testing.assert_allclose(fit_points(residuals._replace(pixel=pixel))[:2], TRUE[:2], rtol=0.3)


def test_without_depth_there_is_no_noise_of_depth() -> None:
    found = fit_points(_residuals(with_depth=0.0))
    assert found.pixel == pytest.approx(TRUE.pixel, rel=0.05)
    assert np.isnan(found.depth)


@pytest.mark.parametrize("factor", [0.3, 1.0, 2.5])
def test_factor_of_motions_is_found(factor: float) -> None:
    assert fit_motions(_motions(factor)).factor == pytest.approx(factor, rel=0.03)
    assert fit_motions(_motions(factor), factor=1.0).factor == 1.0


def test_a_motion_that_is_far_off_changes_little() -> None:
    motions = _motions(1.0, 300)
    motions[::50] = 1e6
    assert 0.9 < fit_motions(motions).factor < 1.7


def test_halves_hold_every_other_part() -> None:
    part, first = halves(np.arange(100), 10)
    assert np.unique(part).tolist() == list(range(10))
    assert first.sum() == 50
    assert (first == (part % 2 == 0)).all()
    assert halves(np.zeros(3, np.int64), 10)[0].tolist() == [0, 0, 0]
