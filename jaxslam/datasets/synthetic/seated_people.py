"""People who sit at the desk and hardly move: the trunk sways, the head turns, and an arm is raised now and then.

In the manner of the `sitting` recordings of TUM RGB-D. Motions are closed forms of time in float64, as those of the
actors who walk; at the head they reach some five centimeters, and a hand is raised by some forty.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.datasets.synthetic.body import TRUNK, below, body, bone
from jaxslam.datasets.synthetic.homogeneous import transform
from jaxslam.datasets.synthetic.primitives import PlacedSolid, Solid, box, upright
from jaxslam.datasets.synthetic.room import CLOTH, METAL
from jaxslam.geometry.so3 import axis_rotation, matrices, multiply

_SEAT_M = 0.47
"""Height of the seats of all chairs."""
_HIP_M = 0.555
"""Height of the hip joints on them, of a person of average size."""
_SUNK_M = 0.92 - _HIP_M
"""How much lower the trunk is than in a standing person, see `body.TRUNK`."""
_THIGH, _LEAN = -1.38, 0.06
"""Radians from hanging down, and from upright."""
_ARM_AT_REST, _ARM_RAISED = np.array([-0.35, -1.60]), np.array([-0.75, -2.65])
"""Upper arm and forearm, radians from hanging down."""


class _Place(NamedTuple):
    """Seat of a person: the point on the floor under the hips, in meters, and the direction."""

    x: float
    y: float
    facing_deg: float


_PLACES = (_Place(0.45, 1.22, -90.0), _Place(0.45, -1.22, 90.0))
"""At the ends of the desk, seen from the side by a camera before it."""
MAX_SEATED = len(_PLACES)


class SeatedBody:
    """A body that sits on a chair; the same fifteen solids as one that walks."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Choose size, clothes and the phases of the motions."""
        self._scale = rng.uniform(0.94, 1.0)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 5)
        self._pace = rng.uniform(0.85, 1.1)
        self._arm = int(rng.integers(2))
        self.solids: list[Solid] = body(self._scale, rng)

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        """Placements of the body's solids in its frame: `(t, 15, 4, 4)`."""
        sway, turn, lift = self._motion(time_s)
        limbs = [_limbs(side, sway, lift * (side == self._arm)) for side in range(2)]
        parts = np.stack([*_trunk(sway, turn), *limbs[0], *limbs[1]], axis=1)
        # Whoever is small sits as high: the seat is where it is.
        parts[..., :3, 3] *= self._scale
        parts[..., 2, 3] += _SEAT_M * (1.0 - self._scale)
        return parts

    def _motion(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation of the trunk `(t, 4)`, wxyz, turn of the head `(t,)` in radians, and lift of an arm, 0 to 1."""
        wave = lambda k, period_s: np.sin(2.0 * np.pi * self._pace * time_s / period_s + self._phase[k])
        pitch = _LEAN + 0.035 * wave(0, 4.6) + 0.012 * wave(1, 2.3)
        roll = 0.03 * wave(2, 6.1)
        # The third power keeps the arm down most of the time.
        return (
            multiply(axis_rotation(1, pitch), axis_rotation(0, roll)),
            0.45 * wave(3, 7.3),
            (0.5 + 0.5 * wave(4, 5.2)) ** 3,
        )


class SeatedPerson(SeatedBody):
    """A person on a chair at the desk."""

    label = "person"

    def __init__(self, place: int, seed: int) -> None:
        """Choose what `SeatedBody` does.

        Args:
            place: Number of the chair, from 0 to below `MAX_SEATED`.
            seed: Seed of the scene.
        """
        super().__init__(np.random.default_rng([seed, 500, place]))
        self._place = _PLACES[place]

    def root(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of the point on the floor under the hips, x forward, which rests: `(t, 7)`, wxyz_xyz."""
        turn = axis_rotation(2, np.deg2rad(self._place.facing_deg))
        pose = np.concatenate([turn, [self._place.x, self._place.y, 0.0]])
        return np.broadcast_to(pose, (len(time_s), 7))


def chairs(seated: int, seed: int) -> list[PlacedSolid]:
    """The chairs of those who sit, which are not there without them: static.

    Args:
        seated: Number of seated people.
        seed: Chooses textures.
    """
    rng = np.random.default_rng([seed, 501])
    return [thing for place in _PLACES[:seated] for thing in _chair(place, rng)]


def _chair(place: _Place, rng: np.random.Generator) -> list[PlacedSolid]:
    floor = upright(place.x, place.y, 0.0, place.facing_deg)
    return [
        PlacedSolid(floor @ upright(0.0, 0.0, _SEAT_M - 0.02), box((0.21, 0.22, 0.02), CLOTH, rng)),
        PlacedSolid(floor @ upright(-0.20, 0.0, 0.75), box((0.02, 0.21, 0.24), CLOTH, rng)),
        PlacedSolid(floor @ upright(0.0, 0.0, 0.215), box((0.03, 0.03, 0.215), METAL, rng)),
    ]


def _trunk(sway: np.ndarray, turn: np.ndarray) -> list[np.ndarray]:
    """Torso, hips, neck, head and hair, each `(t, 4, 4)`."""
    rotation, head = matrices(sway), matrices(multiply(sway, axis_rotation(2, turn)))
    torso, hips, neck, face, hair = (np.array(place) - [0.0, 0.0, _SUNK_M] for place in TRUNK)
    nape = neck * [0.0, 0.0, 1.0]
    on_neck = lambda part: _swayed(rotation, nape) + head @ (part - nape)
    return [
        transform(rotation, _swayed(rotation, torso)),
        transform(np.eye(3), np.broadcast_to(hips, (len(turn), 3))),
        transform(rotation, _swayed(rotation, neck)),
        transform(head, on_neck(face)),
        transform(head, on_neck(hair)),
    ]


def _swayed(rotation: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Rotate a place on the trunk about the hips by `(t, 3, 3)`; its positions are `(t, 3)`."""
    hip = np.array([0.0, 0.0, _HIP_M])
    return hip + rotation @ (place - hip)


def _limbs(side: int, sway: np.ndarray, lift: np.ndarray) -> list[np.ndarray]:
    """Thigh, shin, foot, upper arm and forearm of the right, 0, or left side, 1, each `(t, 4, 4)`."""
    left = 2.0 * side - 1.0
    still = np.zeros(len(lift))
    hip = np.broadcast_to([0.0, 0.09 * left, _HIP_M], (len(lift), 3))
    knee = hip + below(still + _THIGH, 0.42)
    ankle = knee + below(still, 0.40)
    toe = ankle + below(still - np.pi / 2.0, 0.15)
    shoulder = _swayed(matrices(sway), np.array([0.0, 0.225 * left, 1.40 - _SUNK_M]))
    arm, forearm = (_ARM_AT_REST + lift[:, None] * (_ARM_RAISED - _ARM_AT_REST)).T
    elbow = shoulder + below(arm, 0.27)
    wrist = elbow + below(forearm, 0.30)
    return [
        bone(hip, knee, still + _THIGH),
        bone(knee, ankle, still),
        bone(ankle, toe, still - np.pi / 2.0),
        bone(shoulder, elbow, arm),
        bone(elbow, wrist, forearm),
    ]
