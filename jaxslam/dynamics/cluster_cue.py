"""Cluster cue: compare the mean reprojection error of each depth region with that of all points.

Source: TRS-SLAM (Ji, Wang and Xie, ICRA 2021), equation 1 and section IV: the mean robust reprojection error of each
region of the depth image against a threshold derived from the mean over all regions. The threshold is low on purpose: a
missed moving object costs more than a static surface that is left out.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxslam_kernels.camera import project
from jaxslam_kernels.robust import loss_value
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import Mask, Scalar, Weights

from jaxslam.dynamics.cue import CueInput, CueResult, SettingsCue, threshold_evidence
from jaxslam.dynamics.regions import RegionCueResult, Regions, mean_of_regions, of_points


class ClusterParams(NamedTuple):
    """Parameters of the cluster cue; all scalars.

    Attributes:
        times_mean: A region moves if its mean error exceeds this multiple of the mean error of all points. The paper
            gives no number.
        least_px: A region whose root mean error is below this is static, in pixels; 0 as published. With 1.75 at a
            `robust_px` of 2.45, half of the region's points are wrong; with 1.4 a third are, which rejected static
            surfaces.
        robust_px: Scale beyond which a larger error hardly counts more, in pixels (Geman-McClure loss; the paper uses a
            robust loss without naming it). With Huber's loss, one wrong match in five rejects a static region.
        fewest: Minimum number of points for a mean to be used.
        temperature: Softness of the comparison, as in `cue.threshold_evidence`.
    """

    times_mean: Scalar
    least_px: Scalar
    robust_px: Scalar
    fewest: Scalar
    temperature: Scalar


ClusterCue: TypeAlias = Callable[[CueInput, ClusterParams], CueResult]


@lru_cache  # the same function for the same choice: a new function would be compiled again
def make_cluster_cue(as_published: bool = False) -> ClusterCue:
    """Make the cue that classifies regions of the depth image.

    Args:
        as_published: Whether the overall mean is taken over all points. Otherwise it is taken over those that agree
            with the pose, so that a large moving object does not raise it.
    """

    def cluster_cue(scene: CueInput, params: ClusterParams) -> CueResult:
        """Return the mean error of each point's region in units of the threshold.

        Args:
            scene: Measurements of the points; its `regions` must be set.
            params: Thresholds.

        Raises:
            ValueError: If `scene.regions` is `None`.
        """
        if scene.regions is None:
            raise ValueError("scene.regions: expected regions for the cluster cue, got None; set TrackPlan.regions")
        return _verdict(scene, scene.regions, params, as_published)

    return cluster_cue


def _verdict(scene: CueInput, regions: Regions, params: ClusterParams, as_published: bool) -> CueResult:
    error, known = _robust_errors(scene, params)
    mean, number = mean_of_regions(error, known, regions)
    counts = known if as_published else known & scene.agrees
    overall = jnp.sum(jnp.where(counts, error, 0)) / jnp.maximum(jnp.sum(counts, dtype=error.dtype), 1)
    limit = jnp.maximum(params.times_mean * overall, jnp.square(params.least_px))
    enough = (number >= params.fewest) & (limit > 0)
    weight, evidence, judged = threshold_evidence(mean / jnp.where(limit > 0, limit, 1), enough, params.temperature)[:3]
    one, none = jnp.ones_like(overall), jnp.zeros_like(overall)
    return CueResult(
        weight=of_points(weight, regions, one),
        evidence=of_points(evidence, regions, none),
        known=of_points(judged, regions, jnp.zeros((), bool)),
        regions=RegionCueResult(weight, evidence, judged),
    )


def _robust_errors(scene: CueInput, params: ClusterParams) -> tuple[Weights, Mask]:
    """Compute the robust squared reprojection errors of the points at the pose, in pixels squared, and their validity.

    The errors are those of the points' earlier positions (`X_anchor`), like the keyframe points in the paper: positions
    of tracked points are measured again in every frame, so they drift along with a slowly moving surface.
    """
    X_cam = to_camera(scene.T_world_cam, scene.X_anchor)
    known = scene.followed & jnp.isfinite(scene.uv).all(axis=0) & (X_cam[2] > 0)
    apart = jnp.where(known[None, :], scene.uv - project(scene.intrinsics, X_cam), 0)
    return loss_value(jnp.sum(jnp.square(apart), axis=0), params.robust_px, "geman_mcclure"), known


CUE = SettingsCue("clusters", lambda section: make_cluster_cue(section.as_published), ClusterParams, needs_regions=True)
