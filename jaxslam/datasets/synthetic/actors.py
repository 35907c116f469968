"""Actors of the room: walking people made of capsules, boxes that are carried or pushed, and seated people.

Each actor has a frame of its own: origin on the floor under it (a person) or in its center (a box), x forward, z up.
Motions are closed forms of time in float64, so that ground truth is exact and any frame can be asked for.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from jaxslam.datasets.synthetic.body import TRUNK, below, body, bone
from jaxslam.datasets.synthetic.crate import Crate
from jaxslam.datasets.synthetic.homogeneous import transform
from jaxslam.datasets.synthetic.parked_boxes import ParkedBox
from jaxslam.datasets.synthetic.primitives import Solid
from jaxslam.datasets.synthetic.seated_people import SeatedPerson
from jaxslam.geometry.so3 import axis_rotation


class Actor(Protocol):
    """Something that moves on its own: a `person` or a `box`."""

    label: str
    solids: list[Solid]

    def root(self, time_s: np.ndarray) -> np.ndarray:
        """Poses `T_world_actor` at `(t,)` seconds: `(t, 7)`, wxyz_xyz."""
        ...

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        """Placements `T_actor_solid` of its solids: `(t, len(solids), 4, 4)`."""
        ...


class GroundMotion(NamedTuple):
    """Motion of something on the floor, at `t` times.

    Attributes:
        position: `(t, 2)` meters.
        heading: `(t,)` radians from the x axis of the world towards its y axis.
        speed_m_per_s: `(t,)`.
    """

    position: np.ndarray
    heading: np.ndarray
    speed_m_per_s: np.ndarray


Walk: TypeAlias = Callable[[np.ndarray], GroundMotion]
"""Motion on the floor at `(t,)` seconds since the start."""


@dataclass(frozen=True)
class Lane:
    """An ellipse on the floor and how it is walked.

    Attributes:
        center: `(x, y)` meters.
        semi_axes: Along x and y, meters.
        rate: Radians a second, negative for clockwise.
    """

    center: tuple[float, float]
    semi_axes: tuple[float, float]
    rate: float


_ACROSS_VIEW = (
    Lane((-0.90, 0.0), (0.10, 0.70), 0.95),
    Lane((-0.38, 0.0), (0.10, 0.85), -0.80),
    Lane((1.50, 0.0), (0.30, 1.30), 0.50),
)
_ROUND_DESK = (Lane((0.4, 0.0), (0.85, 1.10), 0.45),)


def cast(path: str, people: int, boxes: int, seated: int, parked: int, seed: int) -> list[Actor]:
    """The actors of a scene.

    The first two cross the view of the camera close in front of it and in front of the desk, the others go round
    behind the desk; where the camera goes round the desk, all go round it too. Those who share a lane are spread
    evenly over it; many of them walk through each other.

    Args:
        path: The camera's path.
        people: Number of walking people; they are actors 1 to `people`.
        boxes: Number of carried boxes; the actors after the people.
        seated: Number of seated people, see `seated_people`; the actors after the boxes.
        parked: Number of boxes that stand and are pushed now and then, see `parked_boxes`; the last actors.
        seed: Chooses where they start, their sizes and clothes.
    """
    lanes = _ROUND_DESK if path == "loop" else _ACROSS_VIEW
    actors: list[Actor] = []
    for index in range(people + boxes):
        lane = min(index, len(lanes) - 1)
        sharing = people + boxes - lane if lane == len(lanes) - 1 else 1
        start = np.random.default_rng([seed, 300, lane]).uniform(0.0, 2.0 * np.pi)
        start += 2.0 * np.pi * (index - lane) / sharing
        rng = np.random.default_rng([seed, 200, index])
        walk = partial(_walk, lanes[lane], start)
        actors.append(Person(walk, start, rng) if index < people else CarriedBox(walk, start, rng))
    actors += [SeatedPerson(place, seed) for place in range(seated)]
    return actors + [ParkedBox(place, seed) for place in range(parked)]


def _walk(lane: Lane, start: float, time_s: np.ndarray) -> GroundMotion:
    """Motion on a lane, with a pace that varies a little."""
    angle = start + lane.rate * time_s + 0.15 * np.sin(0.9 * time_s + start)
    rate = lane.rate + 0.135 * np.cos(0.9 * time_s + start)
    a, b = lane.semi_axes
    position = np.array(lane.center) + np.stack([a * np.cos(angle), b * np.sin(angle)], axis=-1)
    speed = np.abs(rate) * np.hypot(a * np.sin(angle), b * np.cos(angle))
    # A lane is narrow; whoever turns at its end turns as on a rounder one, not on the spot.
    rounder = max(a, 0.4 * b)
    sign = np.sign(lane.rate)
    heading = np.arctan2(sign * b * np.cos(angle), -sign * rounder * np.sin(angle))
    return GroundMotion(position, heading, speed)


_STRIDES_PER_S = 0.85
_LEG_M = 0.88
_TRUNK = np.stack([transform(np.eye(3), np.array(place)) for place in TRUNK])


class Person:
    """A walking person of fifteen capsules and ellipsoids; the swing of arms and legs follows the speed."""

    label = "person"

    def __init__(self, walk: Walk, phase: float, rng: np.random.Generator) -> None:
        """Choose size and clothes.

        Args:
            walk: Where the person is at any time.
            phase: Phase of the strides at time 0, in radians.
            rng: Chooses size and clothes.
        """
        self._walk, self._phase = walk, phase
        self._scale = rng.uniform(0.94, 1.05)
        self.solids = body(self._scale, rng)

    def root(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of the point on the floor under the hips, x forward: `(t, 7)`, wxyz_xyz."""
        position, heading, _ = self._walk(time_s)
        floor = np.zeros((len(position), 1))
        return np.concatenate([axis_rotation(2, heading), position, floor], axis=1)

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        """Placements of the body's solids in its frame: `(t, 15, 4, 4)`."""
        speed = self._walk(time_s).speed_m_per_s
        phase = 2.0 * np.pi * _STRIDES_PER_S * time_s + self._phase
        swing = np.arcsin(np.minimum(speed / (4.0 * _STRIDES_PER_S * _LEG_M), 0.6))
        trunk = np.broadcast_to(_TRUNK, (len(time_s), *_TRUNK.shape))
        parts = np.concatenate([trunk, *(_limbs(side, phase, swing) for side in (-1.0, 1.0))], axis=1)
        # The hips sink when the legs are apart.
        parts[..., 2, 3] -= 0.04 * (swing * np.sin(phase))[:, None] ** 2
        parts[..., :3, 3] *= self._scale
        return parts


def _limbs(side: float, phase: np.ndarray, swing: np.ndarray) -> np.ndarray:
    """Thigh, shin, foot, upper arm and forearm of one side, `(t, 5, 4, 4)`; the arm swings against the leg."""
    step = side * np.sin(phase)
    bend = swing * (0.8 + 0.7 * side * np.cos(phase))
    hip, thigh = np.array([0.0, 0.09 * side, 0.92]), -swing * step
    knee = hip + below(thigh, 0.42)
    ankle = knee + below(thigh + bend, 0.40)
    toe = ankle + below(thigh + bend - np.pi / 2.0, 0.15)
    shoulder, arm = np.array([0.0, 0.225 * side, 1.40]), 0.9 * swing * step
    elbow = shoulder + below(arm, 0.27)
    wrist = elbow + below(arm - 0.35, 0.30)
    hips, shoulders = np.broadcast_to(hip, knee.shape), np.broadcast_to(shoulder, elbow.shape)
    begins, ends = (hips, knee, ankle, shoulders, elbow), (knee, ankle, toe, elbow, wrist)
    angles = (thigh, thigh + bend, thigh + bend - np.pi / 2.0, arm, arm - 0.35)
    # All at once: NumPy takes as long for one as for five.
    return bone(np.stack(begins, axis=1), np.stack(ends, axis=1), np.stack(angles, axis=1))


class CarriedBox(Crate):
    """A textured box carried about at the height of a chest, turning as it goes: a mover no detector knows."""

    def __init__(self, walk: Walk, phase: float, rng: np.random.Generator) -> None:
        """Choose size and pattern; whoever carries it walks as `walk` says, and `phase` is that of its turns."""
        self._walk, self._start = walk, phase
        half_m = rng.uniform((0.16, 0.20, 0.18), (0.22, 0.32, 0.34))
        super().__init__(half_m, ((0.50, 0.40, 0.26), (0.72, 0.58, 0.40)), rng)

    def root(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of the center of the box: `(t, 7)`, wxyz_xyz."""
        position, _, _ = self._walk(time_s)
        height = 1.1 + 0.18 * np.sin(0.7 * time_s + 2.0 * self._start)
        turn = 0.5 * np.sin(0.45 * time_s + self._start)
        return np.concatenate([axis_rotation(2, turn), position, height[:, None]], axis=1)
