"""Alignment of trajectories, and their absolute and relative errors, differentiable in the poses.

Poses that cannot be used (weight zero or not finite, a coordinate not finite or beyond `MAX_DISTANCE`) do not
count anywhere and have zero gradient. A length or an angle of exactly zero has gradient zero too.

Source: Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", PAMI
1991; Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, for the two errors.
"""

import enum
from typing import Annotated, Literal, NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.derivative_rules import custom_jvp
from jaxslam_kernels.se3 import cross_matrix, lenient_promotion
from jaxslam_kernels.types import Code, Mask, Points, Scalar, Weights

AlignmentKind: TypeAlias = Literal["none", "se3", "sim3"]
"""What is fitted before positions are compared: nothing, a rigid motion, a rigid motion with a scale."""

MAX_DISTANCE = 1e9
"""Meters. A position further out than this is no position: it counts as not finite."""

_Matrix: TypeAlias = Float[Array, "3 3"]
_Vector: TypeAlias = Float[Array, "3"]


class AlignmentStatus(enum.IntEnum):
    """Quality of an alignment."""

    OK = 0
    ROTATION_UNDETERMINED = 1
    """The positions lie on a line or in a point: the rotation about it is arbitrary, the RMSE is not."""
    TOO_FEW = 2
    """Fewer than three poses count: brought as close as possible, which says nothing about the rest."""


class Alignment(NamedTuple):
    """The similarity `X_reference = T_reference_estimate @ (scale * X_estimate)`.

    Attributes:
        T_reference_estimate: Rotation and translation.
        scale: Scale applied to the estimate first; 1 if not asked for.
        status: An `AlignmentStatus`.
    """

    T_reference_estimate: SE3
    scale: Scalar
    status: Code

    def apply(self, estimate_xyz: Points) -> Points:
        """Positions of the estimate, in the reference's frame."""
        R = self.T_reference_estimate.rotation().as_matrix()
        return _matmul(R, self.scale * estimate_xyz) + self.T_reference_estimate.translation()[:, None]


class Statistics(NamedTuple):
    """Weighted figures of errors, all in the unit of the errors; zeros if nothing counts.

    Attributes:
        rmse: Root of the mean square.
        mean: Mean.
        median: Median; halfway between the two middle values where there are two.
        maximum: Largest.
        std: Standard deviation about the mean, of the population.
    """

    rmse: Scalar
    mean: Scalar
    median: Scalar
    maximum: Scalar
    std: Scalar


class AbsoluteErrors(NamedTuple):
    """Absolute trajectory error (ATE).

    Attributes:
        distances: `(n,)` meters between aligned estimate and reference, 0 where a pose does not count.
        statistics: Figures of the distances; `statistics.rmse` is what papers call the ATE.
        alignment: Alignment applied to the estimate.
        num_poses: Number of poses that count.
    """

    distances: Weights
    statistics: Statistics
    alignment: Alignment
    num_poses: Code


class RelativeErrors(NamedTuple):
    """Relative pose error (RPE), one a pair; 0 where a pair does not count.

    Attributes:
        translations: `(m,)` meters.
        rotations: `(m,)` radians, 0 to pi.
        translation: Figures of the translations.
        rotation: Figures of the rotations.
        num_pairs: Number of pairs that count.
    """

    translations: Float[Array, " m"]
    rotations: Float[Array, " m"]
    translation: Statistics
    rotation: Statistics
    num_pairs: Code


@checked
def align(estimate_xyz: Points, reference_xyz: Points, weights: Weights, *, with_scale: bool) -> Alignment:
    """The least-squares rigid or similarity transform of estimate to reference (Umeyama, eqs. 34 to 43).

    Differentiable with respect to positions and weights, also twice, also for planar and symmetric
    trajectories. Where the rotation is undetermined about an axis, its derivative about that axis is zero.

    Args:
        estimate_xyz: `(3, n)` estimated positions, meters.
        reference_xyz: `(3, n)` true positions at the same times, meters.
        weights: `(n,)` non-negative weights; a mask works as `mask.astype(dtype)`.
        with_scale: Whether to estimate a scale too, static.

    Returns:
        The alignment; the identity if nothing counts.
    """
    weights, (estimate_xyz, reference_xyz) = _usable(weights, estimate_xyz, reference_xyz)
    alignment, _ = _fit(estimate_xyz, reference_xyz, weights, with_scale)
    return alignment


@checked
def ate(
    estimate_xyz: Points, reference_xyz: Points, weights: Weights, *, alignment: AlignmentKind = "se3"
) -> AbsoluteErrors:
    """Distances between positions at the same times, after alignment.

    Args:
        estimate_xyz: `(3, n)` estimated positions, meters; `T_world_cam.translation().T` of a batch of poses.
        reference_xyz: `(3, n)` true positions, meters.
        weights: `(n,)` non-negative weights, of the alignment and of the statistics alike.
        alignment: Kind of alignment, static.
    """
    weights, (estimate_xyz, reference_xyz) = _usable(weights, estimate_xyz, reference_xyz)
    if alignment == "none":
        fitted, residuals = _identity(weights), estimate_xyz - reference_xyz
    else:
        fitted, residuals = _fit(estimate_xyz, reference_xyz, weights, with_scale=alignment == "sim3")
    distances = _norm(residuals.T)
    statistics = _statistics(distances, weights)
    return AbsoluteErrors(jnp.where(weights > 0, distances, 0.0), statistics, fitted, _count(weights))


@checked
def rpe(
    estimate: Annotated[SE3, "n"],
    reference: Annotated[SE3, "n"],
    first: Int[Array, " m"],
    second: Int[Array, " m"],
    mask: Bool[Array, " m"],
) -> RelativeErrors:
    """Errors of the motion between pairs of poses, `(Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j)` (Sturm, eq. 1).

    Args:
        estimate: P, a batch of `n` poses `T_world_cam`; quaternions need not be exactly of unit length.
        reference: Q, a batch of `n` true poses at the same times, in any world frame.
        first: `(m,)` indices i.
        second: `(m,)` indices j; a pair with an index out of range does not count.
        mask: `(m,)` which pairs count.
    """
    if estimate.wxyz_xyz.shape[0] == 0:  # one that is none, so that indices have something to look at
        estimate = reference = SE3(jnp.zeros((1, 7), estimate.wxyz_xyz.dtype))
    P, P_known = usable_poses(estimate)
    Q, Q_known = usable_poses(reference)
    known = P_known & Q_known
    inside = (jnp.minimum(first, second) >= 0) & (jnp.maximum(first, second) < known.shape[0])
    counts = mask & inside & known[first] & known[second]
    P_motion, P_rotation = _motion(P, first, second)
    Q_motion, Q_rotation = _motion(Q, first, second)
    translations = jnp.where(counts, _norm(P_motion - Q_motion), 0.0)
    rotations = jnp.where(counts, _angle(_between(Q_rotation, P_rotation)), 0.0)
    weights = counts.astype(translations.dtype)
    translation, rotation = _statistics(translations, weights), _statistics(rotations, weights)
    return RelativeErrors(translations, rotations, translation, rotation, _count(weights))


@custom_jvp
def nearest_rotation(matrix: _Matrix) -> _Matrix:
    """The rotation R that maximizes `tr(Rᵀ M)`: the polar factor of M, kept proper.

    The identity for the zero matrix; one of the maximizers where several are equally good.
    """
    U, _, Vt = jnp.linalg.svd(matrix)
    u, v = U.T, Vt
    # The third axes as cross products: no sign to find, no use of the arbitrary third axes of a planar set.
    return jnp.stack([u[0], u[1], jnp.cross(u[0], u[1])]).T @ jnp.stack([v[0], v[1], jnp.cross(v[0], v[1])])


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[_Matrix], tangents: tuple[_Matrix]) -> tuple[_Matrix, _Matrix]:
    """With `R = R(M)`, `P = RᵀM` symmetric and `dR = R [ω]ₓ`: `(tr(P) I - P) ω = vee(Rᵀ dM - dMᵀ R)`.

    The eigenvalues on the left are sums of two signed singular values of M, never differences: repeated ones
    do no harm, as they would in the derivative of the SVD. A sum of zero marks an axis about which R is
    undetermined; there ω is zero.
    """
    (matrix,), (d_matrix,) = primals, tangents
    R = nearest_rotation(matrix)
    P = R.T @ matrix
    skew = R.T @ d_matrix
    skew = skew - skew.T
    right = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    axes, sums, determined = _axes(P)
    inverse = jnp.where(determined, 1.0 / jnp.where(determined, sums, 1.0), 0.0)
    omega = lax.custom_linear_solve(
        lambda vector: jnp.trace(P) * vector - 0.5 * ((P + P.T) @ vector),
        right,
        lambda _, vector: axes @ (inverse * (axes.T @ vector)),
        symmetric=True,
    )
    return R, R @ cross_matrix(omega)


def _axes(P: _Matrix) -> tuple[_Matrix, _Vector, Bool[Array, "3"]]:
    """Eigenvectors of P as columns, the sum of the two other eigenvalues of each, and which are not zero."""
    eigenvalues, axes = jnp.linalg.eigh(lax.stop_gradient(P))
    sums = jnp.roll(eigenvalues, -1) + jnp.roll(eigenvalues, -2)
    precision = jnp.finfo(P.dtype)
    return axes, sums, sums > jnp.maximum(32.0 * precision.eps * jnp.max(sums), 1e8 * precision.tiny)


def _fit(x: Points, y: Points, weights: Weights, with_scale: bool) -> tuple[Alignment, Points]:
    """The alignment of usable x to y, and what remains, `scale R x + t - y`, computed about the centroids."""
    share = _shares(weights)
    x_mean, x = _centered(x, share)
    y_mean, y = _centered(y, share)
    covariance = _matmul(share[None, :] * y, x.T)
    R = nearest_rotation(covariance)
    variance = jnp.sum(share * jnp.sum(x * x, axis=0))
    scale = _scale(covariance, R, variance) if with_scale else jnp.ones_like(variance)
    translation = y_mean - scale * jnp.sum(R * x_mean[None, :], axis=1)
    T = SE3.from_rotation_and_translation(SO3.from_matrix(R), translation)
    return Alignment(T, scale, _status(covariance, R, _count(weights))), scale * _matmul(R, x) - y


def _status(covariance: _Matrix, R: _Matrix, count: Code) -> Code:
    _, _, determined = _axes(R.T @ covariance)
    status = jnp.where(determined.all(), AlignmentStatus.OK, AlignmentStatus.ROTATION_UNDETERMINED)
    return jnp.where(count < 3, AlignmentStatus.TOO_FEW, status).astype(count.dtype)


def _scale(covariance: _Matrix, R: _Matrix, variance: Scalar) -> Scalar:
    """Umeyama's eq. 42, `tr(DS) / σₓ²`; 1 for an estimate that does not move."""
    moves = variance > 0
    return jnp.where(moves, jnp.sum(R * covariance) / jnp.where(moves, variance, 1.0), 1.0)


def _identity(like: Weights) -> Alignment:
    parameters = jnp.array([1, 0, 0, 0, 0, 0, 0], like.dtype)
    return Alignment(SE3(parameters), jnp.ones((), like.dtype), jnp.asarray(AlignmentStatus.OK, jnp.int32))


def _usable(weights: Weights, *positions: Points) -> tuple[Weights, list[Points]]:
    """Weights with zeros, and positions with zeros, where any position or the weight cannot be used."""
    # Of weight 0 too, if any others count: the derivative by the weight sees where the pose is.
    known = ((weights > 0) | ((weights == 0) & (weights > 0).any())) & (weights < jnp.inf)
    for xyz in positions:
        known = known & (jnp.abs(xyz) < MAX_DISTANCE).all(axis=0)
    return jnp.where(known, weights, 0.0), [jnp.where(known[None, :], xyz, 0.0) for xyz in positions]


def _count(weights: Weights) -> Code:
    return jnp.sum(weights > 0, dtype=jnp.int32)


def _shares(weights: Weights) -> Weights:
    total = jnp.sum(weights)
    return weights / jnp.where(total > 0, total, 1.0)


def _centered(xyz: Points, share: Weights) -> tuple[_Vector, Points]:
    """Weighted mean, and positions relative to it.

    Summed relative to one of the positions: if all are equal the result is exactly zero, and distance from
    the origin costs no precision.
    """
    if xyz.shape[1] == 0:
        return jnp.zeros(3, xyz.dtype), xyz
    origin = lax.stop_gradient(xyz[:, jnp.argmax(share)])
    local = xyz - origin[:, None]
    mean = jnp.sum(share[None, :] * local, axis=1)
    return origin + mean, local - mean[:, None]


def _statistics(errors: Weights, weights: Weights) -> Statistics:
    share = _shares(weights)
    mean = jnp.sum(share * errors)
    return Statistics(
        rmse=_root(jnp.sum(share * errors * errors)),
        mean=mean,
        median=_median(errors, weights),
        maximum=jnp.max(jnp.where(weights > 0, errors, 0.0), initial=0.0),
        std=_root(jnp.sum(share * jnp.square(errors - mean))),
    )


def _median(errors: Weights, weights: Weights) -> Scalar:
    """The mean of the two values around half of the weight: NumPy's median if the weights are a mask."""
    if errors.shape[0] == 0:
        return jnp.zeros((), errors.dtype)
    order = jnp.argsort(jnp.where(weights > 0, errors, jnp.inf))
    reached = jnp.cumsum(weights[order])
    half = 0.5 * reached[-1]
    lower, upper = jnp.argmax(reached >= half), jnp.argmax(reached > half)
    return 0.5 * (errors[order[lower]] + errors[order[upper]])


@checked
def usable_poses(T: Annotated[SE3, "n"]) -> tuple[SE3, Mask]:
    """The batch with unit quaternions and the identity for poses that cannot be used, and which ones can."""
    wxyz, xyz = T.wxyz_xyz[:, :4], T.wxyz_xyz[:, 4:]
    largest = jnp.max(jnp.abs(wxyz), axis=1)
    known = (jnp.abs(xyz) < MAX_DISTANCE).all(axis=1) & (largest > 1e-3) & (largest < 1e3)
    identity = jnp.array([1, 0, 0, 0], wxyz.dtype)
    wxyz = jnp.where(known[:, None], wxyz, identity[None, :])
    unit = wxyz / _norm(wxyz)[:, None]
    return SE3(jnp.concatenate([unit, jnp.where(known[:, None], xyz, 0.0)], axis=1)), known


def _motion(T: SE3, first: Int[Array, " m"], second: Int[Array, " m"]) -> tuple[Float[Array, "m 3"], SO3]:
    """Translation and rotation of `T_i⁻¹ T_j`. Subtracts positions first: exact far from the origin."""
    wxyz, xyz = T.wxyz_xyz[:, :4], T.wxyz_xyz[:, 4:]
    R_first = SO3(wxyz[first])
    step = xyz[second] - xyz[first]
    with lenient_promotion():
        translation, rotation = R_first.inverse() @ step, R_first.inverse() @ SO3(wxyz[second])
    return translation.astype(xyz.dtype), SO3(rotation.wxyz.astype(wxyz.dtype))


def _between(R_a: SO3, R_b: SO3) -> SO3:
    with lenient_promotion():
        return SO3((R_a.inverse() @ R_b).wxyz.astype(R_b.wxyz.dtype))


def _angle(R: SO3) -> Float[Array, " m"]:
    """Angle of a rotation, 0 to pi. Well conditioned at both ends, unlike the arc cosine of the trace."""
    return 2.0 * jnp.arctan2(_norm(R.wxyz[:, 1:]), jnp.abs(R.wxyz[:, 0]))


def _norm(vectors: Float[Array, "m d"]) -> Float[Array, " m"]:
    return _root(jnp.sum(vectors * vectors, axis=1))


def _root(squared: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root with derivative 0 at 0."""
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def _matmul(left: Float[Array, "3 k"], right: Float[Array, "k m"]) -> Float[Array, "3 m"]:
    return jnp.matmul(left, right, precision=lax.Precision.HIGHEST)
