"""Epipolar cue: measure how far a point is from the epipolar line on which a static point would lie.

Source: RTS-SLAM (Sensors 2026), algorithm 1, lines 1 to 16: the fundamental matrix of two adjacent frames by 7-point
RANSAC, from points outside semantic regions if there are enough of them, else from all points; then the distance of
each point from its epipolar line. The cue needs neither depth nor a map.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxslam_kernels.two_view.epipolar import epipolar_distances, fundamental_of_poses
from jaxslam_kernels.two_view.fundamental import FundamentalResult, FundamentalStatus, ransac_fundamental
from jaxslam_kernels.types import Mask, Scalar

from jaxslam.dynamics.cue import CueInput, CueResult, SettingsCue, threshold_evidence


class EpipolarParams(NamedTuple):
    """Parameters of the epipolar cue; all scalars.

    Attributes:
        limit_px: Distance from the epipolar line above which a point moves, in pixels: the paper's xi.
        fewest_outside: If no more points than this lie outside masks, points under masks vote too: the paper's N_th.
        border_px: Points closer to the image border than this are not classified, in pixels; optical flow is worse
            there.
        ransac_px: Sampson distance up to which a point supports a matrix, in pixels.
        temperature: Softness of the comparison, as in `cue.threshold_evidence`.
    """

    limit_px: Scalar
    fewest_outside: Scalar
    border_px: Scalar
    ransac_px: Scalar
    temperature: Scalar


EpipolarCue: TypeAlias = Callable[[CueInput, EpipolarParams], CueResult]


@lru_cache  # the same function for the same number: a new function would be compiled again
def make_epipolar_cue(num_hypotheses: int = 32) -> EpipolarCue:
    """Make the cue with this number of RANSAC hypotheses per frame.

    Most moving points are under masks: with 80 % inliers, one sample of seven in five is all inliers, and 32 samples
    miss once in 1,800 frames; with 60 %, once in 2.5 frames. Beyond the paper, the matrix of the coarse camera motion
    is tried as well. With it, a quarter of the hypotheses and a third of the steps are enough.
    """

    def epipolar_cue(scene: CueInput, params: EpipolarParams) -> CueResult:
        """Return the distance of each point from its epipolar line in units of the threshold.

        Nothing is classified in a frame whose motion does not determine the matrix: a camera that stands still or
        rotates in place, or points on one plane. One of many matrices that fit would be no evidence.
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


CUE = SettingsCue("epipolar", lambda section: make_epipolar_cue(section.num_hypotheses), EpipolarParams)
