"""Drift over segments of a path, as the KITTI odometry benchmark measures it, differentiable in the poses.

Source: Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012, and
the program `evaluate_odometry` of the benchmark's development kit.
"""

from typing import Annotated, NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.trajectory.alignment import rpe, usable_poses
from jaxslam_kernels.types import Code, Mask, Scalar

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Lengths of the segments of the benchmark."""
KITTI_STEP = 10
"""Poses from the beginning of one of its segments to that of the next."""

_SHORTEST_M = 1e-3
_Segments: TypeAlias = Float[Array, "k s"]


class SegmentErrors(NamedTuple):
    """Errors of the motion over segments of `k` lengths from `s` beginnings, divided by the length.

    Attributes:
        translations: `(k, s)` meters a meter, 0 where there is no such segment.
        rotations: `(k, s)` radians a meter, 0 where there is no such segment.
        translation: Mean of the translations that count, 0 if none does; times 100 the `t_rel` of papers, percent.
        rotation: Mean of the rotations that count; as degrees times 100 the `r_rel` of papers, degrees per 100 m.
        num_segments: Number of segments that count.
    """

    translations: _Segments
    rotations: _Segments
    translation: Scalar
    rotation: Scalar
    num_segments: Code


@checked
def segment_errors(
    estimate: Annotated[SE3, "n"],
    reference: Annotated[SE3, "n"],
    mask: Mask,
    lengths: Float[Array, " k"],
    *,
    step: int = KITTI_STEP,
) -> SegmentErrors:
    """Errors of the motion over segments of given lengths along the reference's path.

    A segment begins at every `step`-th pose that counts and ends at the first one that is further than the length from
    there along the path. Its error is that of `rpe`, divided by the length asked for, as in the benchmark, not by that
    of the path. Where segments begin and end is a constant for differentiation.

    In float32 the way along kilometers is off by centimeters, so that a segment may end a pose earlier or later.

    Args:
        estimate: Batch of `n` poses `T_world_cam` in the order of time.
        reference: Batch of `n` true poses at the same times, in any world frame.
        mask: `(n,)` which poses count. Those that cannot be used (see `alignment`) do not; they are left out of
            the path and of the count of steps.
        lengths: `(k,)` meters; one below a millimeter has no segments.
        step: From one beginning to the next, at least 1, static. There are `s = ceil(n / step)`, some beyond the end.
    """
    _, estimate_known = usable_poses(estimate)
    usable, reference_known = usable_poses(reference)
    known = mask & estimate_known & reference_known
    order = jnp.argsort(~known, stable=True)  # those that count first
    path = _way(usable.translation()[order], jnp.sum(known, dtype=jnp.int32))
    first, last, found = _segment_ends(path, lengths, step)
    errors = rpe(estimate, reference, order[first.ravel()], order[last.ravel()], found.ravel())
    per_metre = 1.0 / jnp.where(lengths >= _SHORTEST_M, lengths, 1.0)[:, None]
    translations, rotations = (e.reshape(found.shape) * per_metre for e in (errors.translations, errors.rotations))
    share = 1.0 / jnp.maximum(errors.num_pairs, 1).astype(translations.dtype)
    return SegmentErrors(
        translations, rotations, jnp.sum(translations) * share, jnp.sum(rotations) * share, errors.num_pairs
    )


def _way(xyz: Float[Array, "n 3"], count: Code) -> Float[Array, " n"]:
    """Meters along the path from the first position to each; beyond the last that counts it does not go on."""
    xyz = lax.stop_gradient(xyz)
    steps = jnp.linalg.norm(xyz[1:] - xyz[:-1], axis=1)
    steps = jnp.where(jnp.arange(1, len(xyz), dtype=count.dtype) < count, steps, 0.0)
    return jnp.concatenate([jnp.zeros(min(1, len(xyz)), xyz.dtype), jnp.cumsum(steps)])


def _segment_ends(
    path: Float[Array, " n"], lengths: Float[Array, " k"], step: int
) -> tuple[Int[Array, "k s"], Int[Array, "k s"], Bool[Array, "k s"]]:
    """First and last pose of each segment, and whether there is such a one."""
    first = jnp.arange(0, len(path), step, dtype=jnp.int32)
    last = jnp.searchsorted(path, path[first][None, :] + lengths[:, None], side="right")
    # None from a beginning beyond the end of the path either: it does not get further from there.
    found = (lengths[:, None] >= _SHORTEST_M) & (last < len(path))
    return jnp.broadcast_to(first[None, :], last.shape), jnp.minimum(last, len(path) - 1), found
