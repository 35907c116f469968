"""People drawn anew into a rendered world: other ones each time that it is filmed again."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxslam.errors import ConfigError
from jaxslam.geometry.se3 import to_local
from jaxslam.sensors.frame import Frame
from jaxslam.worlds.description import Person, Room, Route, World
from jaxslam.worlds.library import with_places
from jaxslam.worlds.motion import RouteWalk
from jaxslam.worlds.recording import WorldFrame, WorldRecording

_MARGIN_M, _LEAST_WAY_M = 0.5, 1.0
"""Least distance of a way from the walls of its room, and least length of it."""
_PERSON_M = 2.0
"""Largest distance of a person's surface from the person's origin on the floor."""
_SPEEDS_M_PER_S, _PAUSES_S = (0.5, 1.3), (0.0, 3.0)
_CLEAR_M = 0.8
"""Least distance of a person's middle from the camera, as nobody walks through a robot. Of ways drawn in `flat_visits`
without regard to the camera, two thirds led within 0.5 m of it: its lens was covered, and no map helps then."""
_MOST_DRAWS = 100
"""Number of ways from which the one that keeps farthest from the camera is taken, if none is clear of it."""


class PassingPeople:
    """A recording of a world without its own people, into which others are set by depth.

    What is still is rendered once if the recording keeps its frames; only people are rendered again.

    Attributes:
        recording: The recording of the world, without people.
    """

    def __init__(self, recording: WorldRecording, num_people: int) -> None:
        """Take a recording.

        Args:
            recording: Recording of a world in which nobody is.
            num_people: Number of people who walk at a time, each in one of the rooms.

        Raises:
            ConfigError: If the world has no room that is large enough for a way.
        """
        self.recording, self._num_people = recording, num_people
        self._rooms = [room for room in with_places(recording.world).rooms if min(_free_m(room)) > _LEAST_WAY_M]
        if not self._rooms:
            raise ConfigError(f"{recording.name}: expected a room of {_LEAST_WAY_M + 2 * _MARGIN_M} m, got none")
        self._drawn: tuple[int, WorldRecording] | None = None
        self._times_s = 1e-9 * (recording.timestamps_ns - recording.timestamps_ns[0])
        self._camera_m = recording.ground_truth.T_world_cam[:, 4:6] / recording.world.scale

    def render(self, index: int, seed: int) -> WorldFrame:
        """Frame `index` with the people of a seed, and its ground truth: they are numbered after all else."""
        if self._drawn is None or self._drawn[0] != seed:
            self._drawn = seed, WorldRecording(self._people_alone(seed))
        still = self.recording.render(index)
        if not self._in_view(self._drawn[1], index):
            return still
        people = self._drawn[1].render(index)
        behind_m = np.where(still.exact_depth_m > 0, still.exact_depth_m, np.inf)
        shown = (people.instance_mask > 0) & (people.exact_depth_m < behind_m)
        number = people.instance_mask + np.int32(len(self.recording.labels))
        return dataclasses.replace(
            still,
            rgb=np.where(shown[..., None], people.rgb, still.rgb),
            depth_m=np.where(shown, people.depth_m, still.depth_m),
            exact_depth_m=np.where(shown, people.exact_depth_m, still.exact_depth_m),
            instance_mask=np.where(shown, number, still.instance_mask),
            moving_mask=np.where(shown, people.moving_mask, still.moving_mask),
            T_world_instance=np.concatenate([still.T_world_instance, people.T_world_instance]),
        )

    def frame(self, index: int, seed: int) -> tuple[Frame, np.ndarray]:
        """Frame `index` as a camera would deliver it, and the mask `(height, width)` of the people of a seed."""
        rendered = self.render(index, seed)
        return rendered.measured, rendered.instance_mask > len(self.recording.labels)

    def people_of(self, seed: int) -> tuple[Person, ...]:
        """Draw the people of a seed: each walks to and fro in a room, clear of the camera."""
        rng = np.random.default_rng([seed, 907])
        return tuple(Person(route=self._clear_route(rng)) for _ in range(self._num_people))

    def _in_view(self, people: WorldRecording, index: int) -> bool:
        """Tell whether somebody is in the picture, or behind something there."""
        camera, scale = self.recording.camera, self.recording.world.scale
        time_s = self._times_s[index : index + 1]
        X_world = np.stack([instance.poses(time_s)[0, 4:] for instance in people.instances], axis=1)
        X_cam = to_local(self.recording.ground_truth.T_world_cam[index], X_world)
        away_m = np.linalg.norm(X_cam, axis=0)
        half_view = np.arctan(0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy))
        half_person = np.arcsin(np.minimum(scale * _PERSON_M / np.maximum(away_m, 1e-6), 1.0))
        return bool((X_cam[2] > away_m * np.cos(np.minimum(half_view + half_person, np.pi))).any())

    def _people_alone(self, seed: int) -> World:
        """Describe the people of a seed, and nothing else, filmed in the same way."""
        people, whole = self.people_of(seed), self.recording.world
        return dataclasses.replace(
            whole, places=(), rooms=(), roads={}, things=(), ground=None, people=people, light_changes=(), seed=seed
        )

    def _clear_route(self, rng: np.random.Generator) -> Route:
        """Draw a way that keeps clear of the camera, or else the one of many that keeps farthest from it."""
        best = _route(self._rooms, rng)
        best_m = self._clearance_m(best)
        for _ in range(_MOST_DRAWS - 1):
            if best_m >= _CLEAR_M:
                break
            other = _route(self._rooms, rng)
            other_m = self._clearance_m(other)
            if other_m > best_m:
                best, best_m = other, other_m
        return best

    def _clearance_m(self, route: Route) -> float:
        """Return the least distance of somebody on a way from the camera, along the floor."""
        apart_m = RouteWalk(route)(self._times_s).position - self._camera_m
        return float(np.linalg.norm(apart_m, axis=1).min())


def without_people(world: World) -> World:
    """Return a world in which nobody is, and everything that moves or is moved has left."""
    things = tuple(
        thing for thing in world.things if thing.route is None and thing.from_s == 0.0 and thing.until_s is None
    )
    return dataclasses.replace(world, things=things, people=(), groups=(), hands=(), faults=())


def _free_m(room: Room) -> tuple[float, float]:
    return room.size_m[0] - 2 * _MARGIN_M, room.size_m[1] - 2 * _MARGIN_M


def _route(rooms: Sequence[Room], rng: np.random.Generator) -> Route:
    """Draw a way to and fro in one of the rooms, the larger the more likely."""
    areas = np.array([width * length for width, length in map(_free_m, rooms)])
    room = rooms[rng.choice(len(rooms), p=areas / areas.sum())]
    while True:
        ends = np.array(room.at_m) + rng.uniform(-0.5, 0.5, (2, 2)) * np.array(_free_m(room))
        if np.linalg.norm(ends[1] - ends[0]) >= _LEAST_WAY_M:
            break
    (x0, y0), (x1, y1) = ends.tolist()
    speed, pause = float(rng.uniform(*_SPEEDS_M_PER_S)), float(rng.uniform(*_PAUSES_S))
    return Route(points_m=((x0, y0), (x1, y1)), speed_m_per_s=speed, pause_s=pause)
