"""What a cue is given and what it says, the same for all of them, and how several become one weight a point.

A cue measures something that points at rest do not show, in units in which 1 is the limit. Published systems compare
with the limit and drop what is beyond; with a temperature the same comparison is smooth, and has a derivative.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.camera import Intrinsics
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Float, Key

from jaxslam.dynamics.regions import RegionCueResult, Regions


class CueInput(NamedTuple):
    """What is known of `n` points between two frames, before the pose of the second is refined.

    Attributes:
        uv_before: `(2, n)` where they are in the frame before, pixels of the camera of `intrinsics`.
        uv: `(2, n)` where they are now.
        followed: `(n,)` which are there in both and under no mask.
        masked: `(n,)` which are there in both and under a mask: they do not count, whatever is said of them.
        agrees: `(n,)` which of those that are followed agree with `T_world_cam`.
        weight: `(n,)` how much each counts before anything is said of it.
        depth_before: `(n,)` meters in the frame before, 0 where not measured.
        depth: `(n,)` meters now, 0 where not measured.
        X_world: `(3, n)` where they are in the world, meters, as measured over the last few frames.
        X_anchor: `(3, n)` where they were up to half a second ago, meters.
        T_world_before: Pose of the camera in the frame before.
        T_world_cam: Its pose now, as most points have it.
        intrinsics: The camera. The tracker's is one without lens distortion and with a global shutter.
        size: `(2,)` columns and rows of the picture.
        key: Of the random choices of this frame.
        regions: Parts of the depth image; `None` without `TrackPlan.regions`.
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


class CueResult(NamedTuple):
    """What a cue says of each point.

    Attributes:
        weight: `(n,)` 0 for what moves to 1 for what is at rest; 1 where nothing is known.
        evidence: `(n,)` what was measured, in units of its limit; 0 where nothing is known.
        known: `(n,)` where something is.
        regions: The same of each of `Scene.regions`, if it is said of them as a whole.
    """

    weight: Weights
    evidence: Weights
    known: Mask
    regions: RegionCueResult | None = None


Cue: TypeAlias = Callable[[CueInput, Any], CueResult]
"""A pure function of what is known and of its own parameters, a pytree. `TrackPlan.cues` takes any of them."""


def threshold_evidence(evidence: Weights, known: Mask, temperature: Scalar) -> CueResult:
    """A verdict by the limit, which is 1.

    Args:
        evidence: `(n,)` not negative; beyond 1 a point moves.
        known: `(n,)` where it is worth anything. Where it is not finite it is not.
        temperature: 0 compares, as published. Above, the weight is `1 / (1 + exp((evidence - 1) / temperature))`:
            one half at the limit, and what comparing gives as the temperature goes to 0.
    """
    known = known & jnp.isfinite(evidence)
    measured = jnp.where(known, evidence, 0)
    smooth = temperature > 0
    soft = jax.nn.sigmoid((1 - measured) / jnp.where(smooth, temperature, 1))
    weight = jnp.where(smooth, soft, (measured <= 1).astype(measured.dtype))
    return CueResult(jnp.where(known, weight, 1), measured, known)


def combine_cues(verdicts: Sequence[CueResult], weight: Weights) -> Weights:
    """`(n,)` the weights times those of all verdicts: every cue has a veto, as every layer has in RTS-SLAM.

    Args:
        verdicts: Of the same points, any number.
        weight: `(n,)` how much each counts without them.
    """
    for verdict in verdicts:
        weight = weight * verdict.weight
    return weight
