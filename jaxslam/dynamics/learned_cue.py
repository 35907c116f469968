"""Learned cue: a small network tells from how far points are from where static ones would be which of them move.

The other cues compare one measurement with one limit. The network reads what they measure: how far a point is, in the
image and in depth, from where the map has it, from where it was measured up to half a second ago, and from where it was
in the last frame, each relative to what is usual in the frame. It looks at them together: of the point, of the region
of the depth image that it is on, and of the whole frame. It is trained in rendered rooms; see
`jaxslam.learning.weights`.

It reads nothing that tells what or where a thing is: neither depth nor size, age or motion in the image. In rendered
rooms what is near, small or new is mostly a person or a box, and a network that reads these learns that instead: on
TUM fr1_rpy, where nothing moves, it then drops the near end of the desk, and the trajectory is 44 mm off instead of 10.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxslam_kernels.camera import back_project, project
from jaxslam_kernels.point_network import PointNetwork, score_points
from jaxslam_kernels.robust import masked_median
from jaxslam_kernels.se3 import to_camera, to_world
from jaxslam_kernels.types import Mask, Points, Scalar, Weights
from jaxtyping import Array, Float

from jaxslam.config.cue_sections import LearnedCueConfig
from jaxslam.dynamics.cue import CueInput, CueResult, SettingsCue, threshold_evidence
from jaxslam.dynamics.network_file import POINT_FEATURES, load_network
from jaxslam.dynamics.regions import RegionCueResult, Regions

_DISTANCES_PX = ("anchor_px", "map_px", "flow_px")
_DISTANCES_SIGMAS = ("anchor_sigmas", "map_sigmas", "flow_sigmas")
_SOFT_PX, _SOFT_DRIFT_PX = 0.01, 1e-4
"""Lengths to which those of distances and of the drift are rounded up, pixels, so that they are smooth at zero."""
_MAX_SIGMAS = 100.0
"""Largest difference of depth that is told from others, as a multiple of the usual one."""
_USUAL_PX, _USUAL_SIGMAS = 0.3, 1.0
"""Smallest distances that are usual in a frame, in pixels and in standard deviations of depth."""


class LearnedParams(NamedTuple):
    """Parameters of `learned_cue`.

    Attributes:
        network: Weights of the network.
        temperature: Softness of the comparison, as in `cue.threshold_evidence`.
    """

    network: PointNetwork
    temperature: Scalar


class LearnedFeatures(NamedTuple):
    """Features of `n` points and `k` regions, as measured.

    Attributes:
        points: `(f, n)` features of the points, in the order of `network_file.POINT_FEATURES`: distances in pixels,
            differences of depth in its standard deviations, and the rest from 0 to 1.
        regions: `(c, k)` features of the regions, in the order of `network_file.GROUP_FEATURES`, of about unit size.
        mask: `(n,)` which points are classified.
    """

    points: Float[Array, "f n"]
    regions: Float[Array, "c k"]
    mask: Mask


def learned_cue(scene: CueInput, params: LearnedParams) -> CueResult:
    """Return the evidence of the network for each point and each region.

    The evidence is twice the probability of motion that the network gives. It is 2 at most, so that a region is
    remembered as moving (`regions.remembered_weights`) after a few frames, and never after a single one.

    Args:
        scene: Measurements of the points; its `regions`, `depth_sigma` and `region_weight` must be set.
        params: Weights of the network.

    Raises:
        ValueError: If something of `scene` that the network reads is `None`.
    """
    regions = _regions(scene)
    features = learned_features(scene)
    inputs = network_inputs(features.points, features.mask)
    scores = score_points(params.network, inputs, features.regions, regions.of_point, features.mask)
    judged = threshold_evidence(_evidence(scores.point), features.mask, params.temperature)
    of_regions = threshold_evidence(_evidence(scores.group), scores.number > 0, params.temperature)
    return judged._replace(regions=RegionCueResult(of_regions.weight, of_regions.evidence, of_regions.known))


def learned_features(scene: CueInput) -> LearnedFeatures:
    """Measure what the network knows of points and regions.

    Raises:
        ValueError: If something of `scene` that the network reads is `None`.
    """
    regions = _regions(scene)
    mask, anchor, fused = _seen(scene)
    table = lax.stop_gradient(_region_features(scene, regions, mask))
    return LearnedFeatures(jnp.stack(_point_features(scene, mask, anchor, fused)), table, mask)


def network_inputs(points: Float[Array, "f n"], mask: Mask) -> Float[Array, "f n"]:
    """Compute the inputs of the network for points: their distances relative to the usual ones, of about unit size.

    What is usual is the median of the points that agree with the coarse pose. A rolling shutter, blur and depth of
    another time make all distances of a frame longer, and with them those of a turning camera.

    Args:
        points: `(f, n)` features of the points, as in `LearnedFeatures`.
        mask: `(n,)` which points are classified.
    """
    row = {name: points[place] for place, name in enumerate(POINT_FEATURES)}
    agrees = mask & (row["agrees"] > 0)
    has_depth = agrees & (row["has_depth"] > 0)
    usual_px = {name: jnp.maximum(masked_median(row[name], agrees), _USUAL_PX) for name in _DISTANCES_PX}
    for name in _DISTANCES_SIGMAS:
        relative = row[name] / jnp.maximum(masked_median(jnp.abs(row[name]), has_depth), _USUAL_SIGMAS)
        row[name] = jnp.arcsinh(jnp.clip(relative, -_MAX_SIGMAS, _MAX_SIGMAS)) / 2
    row["drift_px"] = jnp.log1p(row["drift_px"] / usual_px["anchor_px"]) / 2
    for name in _DISTANCES_PX:
        row[name] = jnp.log1p(row[name] / usual_px[name])
    return jnp.where(mask[None], jnp.stack([*row.values()]), 0)


def _regions(scene: CueInput) -> Regions:
    for name in ("regions", "depth_sigma", "region_weight"):
        if getattr(scene, name) is None:
            raise ValueError(f"scene.{name}: expected a value for the learned cue, got None; set TrackPlan.regions")
    assert scene.regions is not None
    return scene.regions


def _seen(scene: CueInput) -> tuple[Mask, Points, Points]:
    """Return which points are classified, and their two positions in the map in camera axes."""
    anchor, fused = (to_camera(scene.T_world_cam, X) for X in (scene.X_anchor, scene.X_world))
    finite = jnp.isfinite(scene.uv).all(axis=0) & jnp.isfinite(scene.uv_before).all(axis=0)
    finite &= jnp.isfinite(anchor).all(axis=0) & jnp.isfinite(fused).all(axis=0)
    mask = scene.followed & finite & (anchor[2] > 0) & (fused[2] > 0)
    ahead = jnp.array([[0.0], [0.0], [1.0]], fused.dtype)
    return mask, jnp.where(mask[None], anchor, ahead), jnp.where(mask[None], fused, ahead)


def _point_features(scene: CueInput, mask: Mask, anchor: Points, fused: Points) -> list[Weights]:
    """Return the features of points, each `(n,)`."""
    dtype = scene.uv.dtype
    assert scene.depth_sigma is not None
    measured, before = mask & (scene.depth > 0), mask & (scene.depth_before > 0)
    center = jnp.stack([scene.intrinsics.cx, scene.intrinsics.cy])[:, None]
    uv, uv_before = (jnp.where(mask[None], each, center) for each in (scene.uv, scene.uv_before))
    last = back_project(scene.intrinsics, uv_before, jnp.where(before, scene.depth_before, 1))
    carried = to_camera(scene.T_world_cam, to_world(scene.T_world_before, last))
    carried = jnp.where((before & (carried[2] > 0))[None], carried, fused)
    sigma = jnp.where(measured & (scene.depth_sigma > 0), scene.depth_sigma, 1)
    return [
        *(_length(uv - project(scene.intrinsics, X), _SOFT_PX) for X in (anchor, fused, carried)),
        *(jnp.where(measured, (scene.depth - X[2]) / sigma, 0) for X in (anchor, fused, carried)),
        _length(scene.intrinsics.fx * (anchor - fused) / fused[2][None], _SOFT_DRIFT_PX),
        measured.astype(dtype),
        before.astype(dtype),
        (mask & scene.agrees).astype(dtype),
        jnp.where(mask, scene.weight, 0),
    ]


def _region_features(scene: CueInput, regions: Regions, mask: Mask) -> Float[Array, "c k"]:
    """Return the features of regions."""
    assert scene.region_weight is not None
    num, dtype = regions.centers.shape[1], scene.uv.dtype
    to = jnp.where(mask & (regions.of_point >= 0), regions.of_point, num)
    number = jnp.zeros(num, dtype).at[to].add(1, mode="drop")
    return jnp.stack([jnp.log1p(number) / 3, scene.region_weight])


def _length(apart: Float[Array, "d n"], soft: float) -> Weights:
    """Compute lengths that are smooth at zero."""
    return jnp.sqrt(jnp.sum(jnp.square(apart), axis=0) + soft * soft)


def _evidence(score: Float[Array, " n"]) -> Float[Array, " n"]:
    return 2 * jax.nn.sigmoid(score)


def _read_params(section: LearnedCueConfig, temperature: float, dtype: jnp.dtype) -> LearnedParams:
    weights = load_network(section.weights).weights
    network = PointNetwork(**{name: jnp.asarray(value, dtype) for name, value in weights.items()})
    return LearnedParams(network, jnp.asarray(temperature, dtype))


CUE = SettingsCue("learned", lambda _: learned_cue, LearnedParams, needs_regions=True, read_params=_read_params)
