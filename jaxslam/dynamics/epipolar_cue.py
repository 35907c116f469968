"""Epipolar consistency: whether a point is on the line on which one at rest would be.

Source: RTS-SLAM (Sensors 2026), algorithm 1, lines 1 to 16: the fundamental matrix of two adjacent frames by RANSAC of
seven points, from points outside semantic regions if there are enough of them, else from all; and the distance of each
point from its line. It needs neither depth nor map.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxslam_kernels.two_view.epipolar import epipolar_distances, fundamental_of_poses
from jaxslam_kernels.two_view.fundamental import FundamentalResult, FundamentalStatus, ransac_fundamental
from jaxslam_kernels.types import Mask, Scalar

from jaxslam.dynamics.cue import CueInput, CueResult, threshold_evidence


class EpipolarParams(NamedTuple):
    """Of the epipolar cue; scalars.

    Attributes:
        limit_px: Distance from the line beyond which a point moves: the paper's xi.
        fewest_outside: With no more points outside masks, those under masks vote too: the paper's N_th.
        border_px: Points closer to the border of the picture are not judged; flow is worse there.
        ransac_px: Sampson distance up to which a point supports a matrix.
        temperature: See `cue.judge`.
    """

    limit_px: Scalar
    fewest_outside: Scalar
    border_px: Scalar
    ransac_px: Scalar
    temperature: Scalar


EpipolarCue: TypeAlias = Callable[[CueInput, EpipolarParams], CueResult]


@lru_cache  # the same function for the same number: another one would be compiled anew
def make_epipolar_cue(num_hypotheses: int = 32) -> EpipolarCue:
    """The cue with so many hypotheses of the matrix a frame.

    Most points that move are under masks: of 80 % good ones seven are good in one sample of five, and 32 samples miss
    once in 1,800 frames; of 60 %, once in 2.5. Not in the paper: the matrix of the coarse motion of the camera is tried
    besides. With it a quarter of the hypotheses do, and a third of the steps.
    """

    def epipolar_cue(scene: CueInput, params: EpipolarParams) -> CueResult:
        """How far each point is from its line, in limits.

        Nothing is said in a frame whose motion does not determine the matrix: a camera that stands or turns on the
        spot, or points on one plane; one of many matrices that fit would be no evidence.
        """
        judged = (scene.followed | scene.masked) & _clear_of_border(scene, params.border_px)
        found = _matrix(scene, judged, params, num_hypotheses)
        trusted = (found.status == FundamentalStatus.OK) | (found.status == FundamentalStatus.NOT_CONVERGED)
        distance = epipolar_distances(found.F, scene.uv_before, scene.uv)
        return threshold_evidence(distance / params.limit_px, judged & trusted, params.temperature)

    return epipolar_cue


def _matrix(scene: CueInput, judged: Mask, params: EpipolarParams, num_hypotheses: int) -> FundamentalResult:
    outside = judged & ~scene.masked
    enough = jnp.sum(outside, dtype=scene.uv.dtype) > params.fewest_outside
    voters = jnp.where(enough, outside, judged)
    return ransac_fundamental(
        scene.key,
        scene.uv_before,
        scene.uv,
        weights=voters.astype(scene.uv.dtype),
        threshold_px=params.ransac_px,
        num_hypotheses=num_hypotheses,
        num_improved=0,
        initial=fundamental_of_poses(scene.T_world_before, scene.T_world_cam, scene.intrinsics),
    )


def _clear_of_border(scene: CueInput, border_px: Scalar) -> Mask:
    low, high = border_px, (scene.size - 1)[:, None] - border_px
    return ((scene.uv_before >= low) & (scene.uv_before <= high) & (scene.uv >= low) & (scene.uv <= high)).all(axis=0)
