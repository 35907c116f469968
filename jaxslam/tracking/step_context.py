"""What every part of a tracking step reads."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.se3 import displacement
from jaxslam_kernels.types import Flag, Points
from jaxtyping import Array, Float

from jaxslam.sensors.measurement import Measurements, PixelRays, PreparedFrame
from jaxslam.tracking.state import TrackParams, TrackPlan, TrackState

_MIN_ELAPSED_S = 1e-4
"""Shortest time from which a velocity is computed."""


class StepContext(NamedTuple):
    """What every part of a tracking step reads.

    Attributes:
        state: State before the frame.
        view: The frame, prepared.
        params: Parameters of the tracker.
        plan: Plan of the tracker, static.
    """

    state: TrackState
    view: PreparedFrame
    params: TrackParams
    plan: TrackPlan

    def twist_to(self, pose: SE3) -> Float[Array, "6"]:
        """Return the velocity `(6,)` of the camera, in its own axes, that brings it to a pose in this frame."""
        elapsed_s = self.view.elapsed_s
        known = elapsed_s > _MIN_ELAPSED_S
        return jnp.where(known, displacement(self.state.T_world_cam, pose) / jnp.where(known, elapsed_s, 1), 0)

    def has_depth(self) -> Flag:
        """Return whether the frame has depth at all that is to be believed; a sensor may have none for some frames."""
        return self.view.has_depth(self.params.sensor)

    def measured(self, rays: PixelRays, X_world: Points, pose: SE3, twist: Float[Array, "6"]) -> Measurements:
        """Return the measurements of map points `(3, n)`, in meters, that are seen along rays from about `pose`.

        Args:
            rays: Rays of the pixels.
            X_world: `(3, n)` positions of the points in the world, meters.
            pose: Approximate pose of the camera.
            twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        """
        return rays.from_pose(X_world, pose, twist, self.view, self.params.sensor)
