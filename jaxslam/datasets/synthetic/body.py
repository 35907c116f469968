"""The body of a person: fifteen capsules and ellipsoids, and how bones hang on joints.

Axes of a person: x forward, y to the left, z up, origin on the floor under the hips.
"""

import numpy as np

from jaxslam.datasets.synthetic.homogeneous import transform
from jaxslam.datasets.synthetic.primitives import Solid, capsule, pill
from jaxslam.datasets.synthetic.texture import Material
from jaxslam.geometry.so3 import axis_rotation, matrices

_SKIN = Material((0.72, 0.50, 0.38), (0.85, 0.64, 0.52), noise_per_m=9.0, noise=0.35)
_HAIR = Material((0.10, 0.07, 0.05), (0.26, 0.18, 0.12), noise_per_m=20.0, stretch=4.0, noise=0.8)
_SHOE = Material((0.10, 0.10, 0.11), (0.25, 0.24, 0.23), noise_per_m=12.0, noise=0.5)

TRUNK = ((0.0, 0.0, 1.19), (0.0, 0.0, 0.96), (0.01, 0.0, 1.50), (0.02, 0.0, 1.63), (-0.01, 0.0, 1.655))
"""Where torso, hips, neck, head and hair are on a person of average size, in meters."""


def body(scale: float, rng: np.random.Generator) -> list[Solid]:
    """Torso, hips, neck, head and hair, then thigh, shin, foot, upper arm and forearm of the right and the left.

    Args:
        scale: Size, 1 for the average.
        rng: Chooses the clothes.
    """
    shirt, trousers = _clothes(rng, patches=0.6), _clothes(rng, patches=0.15)
    sleeve = shirt if rng.uniform() < 0.6 else _SKIN

    def limb(radius: float, length: float, look: Material) -> Solid:
        return capsule(scale * radius, scale * length, look, rng)

    def oval(radii: tuple[float, float, float], length: float, look: Material) -> Solid:
        x, y, z = (scale * radius for radius in radii)
        return pill((x, y, z), scale * length, look, rng)

    trunk = [
        oval((0.115, 0.185, 0.10), 0.32, shirt),
        oval((0.115, 0.165, 0.10), 0.10, trousers),
        limb(0.055, 0.08, _SKIN),
        oval((0.095, 0.078, 0.12), 0.0, _SKIN),
        oval((0.098, 0.086, 0.115), 0.0, _HAIR),
    ]
    limbs = [
        limb(0.085, 0.42, trousers),
        limb(0.058, 0.40, trousers),
        limb(0.045, 0.15, _SHOE),
        limb(0.052, 0.27, shirt),
        limb(0.042, 0.30, sleeve),
    ]
    return [*trunk, *limbs, *limbs]


def _clothes(rng: np.random.Generator, patches: float) -> Material:
    dark = rng.uniform(0.08, 0.55, 3)
    light = np.clip(dark + rng.uniform(0.1, 0.35, 3), 0.0, 1.0)
    size = rng.uniform(0.10, 0.22)
    bright = np.clip(light + rng.uniform(0.1, 0.4, 3), 0.0, 1.0)
    return Material(
        tuple(dark),
        tuple(light),
        tuple(0.4 * dark),
        tuple(bright),
        noise_per_m=8.0,
        noise=0.6,
        patch_m=size,
        patch_density=patches,
    )


def below(angle: np.ndarray, length: float) -> np.ndarray:
    """`(t, 3)` vectors that hang down, turned about y; a negative angle swings forward."""
    return -length * np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)


def bone(first: np.ndarray, second: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """`(..., 4, 4)` placements of limbs from joint to joint, `(..., 3)` each, turned about y as in `below`."""
    rotation = matrices(axis_rotation(1, angle))
    return transform(rotation, 0.5 * (first + second))
