"""Clusters: whether the points on one surface are, on average, where the map has them.

Source: TRS-SLAM (Ji, Wang and Xie, ICRA 2021), equation 1 and section IV: the mean robust reprojection error of each
region of the depth image against a threshold that depends on the mean over all of them. It is low on purpose: a mover
that is missed costs more than a surface at rest that is left out.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxslam_kernels.camera import project
from jaxslam_kernels.robust import loss_value
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import Mask, Scalar, Weights

from jaxslam.dynamics.cue import CueInput, CueResult, threshold_evidence
from jaxslam.dynamics.regions import RegionCueResult, Regions, mean_of_regions, of_points


class ClusterParams(NamedTuple):
    """Of the cluster cue; scalars.

    Attributes:
        times_mean: A region moves if its mean error is beyond so many times that of all points. The paper gives no
            number.
        least_px: A region whose root mean error is below is at rest, pixels; 0 as published. With
            1.75 at `robust_px` of 2.45 half of its points are wrong; 1.4, a third, gave surfaces at rest away.
        robust_px: Errors beyond count hardly more, however large, pixels (the loss of Geman and McClure; the paper has
            a robust one and does not name it). With Huber's, one wrong match in five gives a region at rest away.
        fewest: Least number of points of which a mean is worth anything.
        temperature: See `cue.judge`.
    """

    times_mean: Scalar
    least_px: Scalar
    robust_px: Scalar
    fewest: Scalar
    temperature: Scalar


ClusterCue: TypeAlias = Callable[[CueInput, ClusterParams], CueResult]


@lru_cache  # the same function for the same choice: another one would be compiled anew
def make_cluster_cue(as_published: bool = False) -> ClusterCue:
    """The cue that judges regions of the depth image.

    Args:
        as_published: Whether the mean over all points is taken over all of them, or over those that agree with the
            pose, which a large mover does not raise.
    """

    def cluster_cue(scene: CueInput, params: ClusterParams) -> CueResult:
        """How large the mean error of each point's region is, in thresholds.

        Args:
            scene: What is known of the points; its `regions` must be there.
            params: Thresholds.

        Raises:
            ValueError: If the scene has no regions.
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
    weight, evidence, judged, _ = threshold_evidence(mean / jnp.where(limit > 0, limit, 1), enough, params.temperature)
    one, none = jnp.ones_like(overall), jnp.zeros_like(overall)
    return CueResult(
        weight=of_points(weight, regions, one),
        evidence=of_points(evidence, regions, none),
        known=of_points(judged, regions, jnp.zeros((), bool)),
        regions=RegionCueResult(weight, evidence, judged),
    )


def _robust_errors(scene: CueInput, params: ClusterParams) -> tuple[Weights, Mask]:
    """Robust squared reprojection errors of the points at the pose, pixels squared, and which are known.

    Of where they were a while ago, as the points of a keyframe in the paper: the places of followed points are measured
    anew in every frame, and go along with what moves slowly.
    """
    X_cam = to_camera(scene.T_world_cam, scene.X_anchor)
    known = scene.followed & jnp.isfinite(scene.uv).all(axis=0) & (X_cam[2] > 0)
    apart = jnp.where(known[None, :], scene.uv - project(scene.intrinsics, X_cam), 0)
    return loss_value(jnp.sum(jnp.square(apart), axis=0), params.robust_px, "geman_mcclure"), known
