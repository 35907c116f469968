"""Result of a calibration: each parameter before and after, with its standard deviation, and why it is as it is."""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.sensors.camera import Camera


class Verdict(Enum):
    """Outcome of a parameter."""

    ACCEPTED = "accepted"
    """Held-out frames are explained better with it."""
    NO_GAIN = "held-out frames are not better"
    """Held-out frames are explained as well without it, so it stays as it was."""
    NOT_SHOWN = "the recording hardly shows it"
    """The standard deviation is hardly smaller than what was assumed beforehand, so it stays as it was."""
    IMPOSSIBLE = "found outside of what a camera file can say"
    """It stays as it was."""
    UNOBSERVABLE = "unobservable"
    """No recording tells it: all residuals are the same if the whole world is larger or smaller."""
    NOT_IN_FILE = "accepted, but not part of a camera file"
    """Held-out frames are explained better with it; `jaxslam run` does not use it."""


class Estimate(NamedTuple):
    """One parameter of a calibration.

    Attributes:
        name: Name; that of a field of `Camera` where there is one.
        unit: Unit; empty for none.
        before: Value in the beginning.
        after: Value in the result.
        found: Value that fits the recording best, whether or not it was accepted; NaN if nothing tells it.
        sigma: Standard deviation of `found`; NaN if nothing tells it.
        verdict: What became of it.
    """

    name: str
    unit: str
    before: float
    after: float
    found: float
    sigma: float
    verdict: Verdict


_NUMBERS = ("before", "after", "found", "sigma")


@dataclass(frozen=True, eq=False)
class ResidualField:
    """Residuals of pixels of held-out frames.

    Attributes:
        uv: `(2, n)` pixels.
        before_px: `(2, n)` residuals with the camera as it was, pixels.
        after_px: `(2, n)` residuals with the calibrated camera, pixels.
        depth_m: `(m,)` measured depths, meters.
        depth_before_m: `(m,)` their residuals with the camera as it was, meters.
        depth_after_m: `(m,)` their residuals with the calibrated camera, meters.
    """

    uv: Float[np.ndarray, "2 n"]
    before_px: Float[np.ndarray, "2 n"]
    after_px: Float[np.ndarray, "2 n"]
    depth_m: Float[np.ndarray, " m"]
    depth_before_m: Float[np.ndarray, " m"]
    depth_after_m: Float[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`.

    Attributes:
        start: Camera in the beginning.
        camera: Calibrated camera.
        estimates: All parameters, those of the gyro too if there is one.
        held_out_gain: Share by which the robust cost of held-out frames is lower than with the camera as it was.
        pixel_sigma: Standard deviation of a tracked point, pixels.
        depth_sigma: Standard deviation of measured depth, as a factor of that in the settings.
        num_blocks: Number of parts of the recording that were used.
        num_frames: Number of frames in them.
        rounds: Number of times that the recording was tracked.
        residuals: Residuals of held-out frames before and after.
    """

    start: Camera
    camera: Camera
    estimates: tuple[Estimate, ...]
    held_out_gain: float
    pixel_sigma: float
    depth_sigma: float
    num_blocks: int
    num_frames: int
    rounds: int
    residuals: ResidualField

    def estimate(self, name: str) -> Estimate:
        """Return the parameter of a name.

        Raises:
            KeyError: If there is none.
        """
        for each in self.estimates:
            if each.name == name:
                return each
        raise KeyError(name)

    def summary(self) -> dict[str, Any]:
        """Return all figures as plain values, for JSON; `None` where nothing tells a number."""
        return {
            "parameters": [_plain(each) for each in self.estimates],
            "held_out_gain": self.held_out_gain,
            "pixel_sigma": self.pixel_sigma,
            "depth_sigma": self.depth_sigma,
            "blocks": self.num_blocks,
            "frames": self.num_frames,
            "rounds": self.rounds,
        }


def _plain(estimate: Estimate) -> dict[str, Any]:
    numbers = {name: None if math.isnan(getattr(estimate, name)) else getattr(estimate, name) for name in _NUMBERS}
    return {"name": estimate.name, "unit": estimate.unit, **numbers, "verdict": estimate.verdict.value}
