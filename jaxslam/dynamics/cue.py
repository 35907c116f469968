"""Common interface of the dynamic cues: their input, their result, and how several results become one weight per point.

A cue measures something that static points do not show, scaled so that the threshold is 1. Published systems compare
with the threshold and drop what exceeds it; with a temperature above 0 the same comparison is smooth and
differentiable.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.camera import Intrinsics
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Float, Int, Key

from jaxslam.dynamics.regions import RegionCueResult, Regions


class CueInput(NamedTuple):
    """Measurements of `n` points in two frames, before the pose of the second frame is refined.

    Attributes:
        uv_before: `(2, n)` pixel positions in the previous frame, for the camera of `intrinsics`.
        uv: `(2, n)` pixel positions in the current frame.
        followed: `(n,)` whether each point is tracked in both frames and outside every mask; with
            `TrackPlan.judge_masked`, also under masks.
        masked: `(n,)` whether each point is tracked in both frames and under a mask. These points have no weight,
            whatever a cue returns for them, unless `TrackPlan.judge_masked` is set.
        agrees: `(n,)` which of the `followed` points are inliers of `T_world_cam`.
        weight: `(n,)` weight of each point before any cue is applied.
        depth_before: `(n,)` depth in the previous frame, in meters; 0 where not measured.
        depth: `(n,)` depth in the current frame, in meters; 0 where not measured.
        X_world: `(3, n)` world positions measured over the last few frames, in meters.
        X_anchor: `(3, n)` world positions measured up to half a second ago, in meters.
        T_world_before: Camera pose of the previous frame.
        T_world_cam: Current camera pose, as most points agree on it.
        intrinsics: Camera intrinsics. The tracker passes a camera without lens distortion and with a global shutter.
        size: `(2,)` columns and rows of the image.
        key: Key of this frame's random choices.
        regions: Regions of the depth image; `None` without `TrackPlan.regions`.
        age: `(n,)` number of frames since each point was detected.
        depth_sigma: `(n,)` standard deviation of `depth`, in meters.
        region_weight: `(k,)` remembered weight of each region in the previous frame, as in `RegionMemory`.
    """

    uv_before: Pixels
    uv: Pixels
    followed: Mask
    masked: Mask
    agrees: Mask
    weight: Weights
    depth_before: Weights
    depth: Weights
    X_world: Points
    X_anchor: Points
    T_world_before: SE3
    T_world_cam: SE3
    intrinsics: Intrinsics
    size: Float[Array, "2"]
    key: Key[Array, ""]
    regions: Regions | None = None
    age: Int[Array, " n"] | None = None
    depth_sigma: Weights | None = None
    region_weight: Float[Array, " k"] | None = None


class CueResult(NamedTuple):
    """Result of a cue for `n` points.

    Attributes:
        weight: `(n,)` from 0 for a moving point to 1 for a static one; 1 where nothing is known.
        evidence: `(n,)` measured value in units of the threshold; 0 where nothing is known.
        known: `(n,)` whether the point could be classified.
        regions: The same result per region of `CueInput.regions`, if the cue classifies whole regions.
        extra: Arrays of the cue's own, for whoever reads `TrackOutput.cue_results`; the tracker does not read them.
    """

    weight: Weights
    evidence: Weights
    known: Mask
    regions: RegionCueResult | None = None
    extra: Any = None


Cue: TypeAlias = Callable[[CueInput, Any], CueResult]
"""A pure function of the measurements and of its own parameters, a pytree. `TrackPlan.cues` accepts any of them."""


class SettingsCue(NamedTuple):
    """A cue that settings can choose; the module that defines it as `CUE` is found by its name, `..._cue.py`.

    Attributes:
        name: Name of the cue in `dynamics.cues`, and of the section of `dynamics` that holds its settings.
        make: Function from that section to the cue.
        params: Class of the parameters. Each field is a setting of the section, except `temperature`, which all cues
            share.
        needs_regions: Whether the cue classifies regions of the depth image.
        read_params: Function from the section, the temperature and the floating-point type to the parameters, for a cue
            whose parameters are not settings; `None` if each is one.
    """

    name: str
    make: Callable[[Any], Cue]
    params: Callable[..., Any]
    needs_regions: bool = False
    read_params: Callable[[Any, float, Any], Any] | None = None


def threshold_evidence(evidence: Weights, known: Mask, temperature: Scalar) -> CueResult:
    """Classify points by comparing their evidence with the threshold, which is 1.

    Args:
        evidence: `(n,)` non-negative measurements; above 1 a point moves.
        known: `(n,)` whether the evidence is usable. Evidence that is not finite never is.
        temperature: At 0 the comparison is hard, as published. Above 0 the weight is
            `1 / (1 + exp((evidence - 1) / temperature))`: one half at the threshold, and equal to the hard comparison
            in the limit of temperature 0.
    """
    known = known & jnp.isfinite(evidence)
    measured = jnp.where(known, evidence, 0)
    smooth = temperature > 0
    soft = jax.nn.sigmoid((1 - measured) / jnp.where(smooth, temperature, 1))
    weight = jnp.where(smooth, soft, (measured <= 1).astype(measured.dtype))
    return CueResult(jnp.where(known, weight, 1), measured, known)


def combine_cues(verdicts: Sequence[CueResult], weight: Weights) -> Weights:
    """Multiply the weights by those of all cue results: every cue has a veto, like every layer of RTS-SLAM.

    Args:
        verdicts: Any number of results for the same points.
        weight: `(n,)` weights before the cues.

    Returns:
        The combined weights, `(n,)`.
    """
    for verdict in verdicts:
        weight = weight * verdict.weight
    return weight
