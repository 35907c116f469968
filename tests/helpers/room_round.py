"""A third of a round of the room, at a size at which places are recognized, and a tracker for it."""

import functools
from dataclasses import fields

from small_scene import Clip

from jaxslam.config.schema import TrackConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.sensors.frame import Frame

WIDTH, HEIGHT, FPS, FRAMES = 320, 240, 15.0, 166
TRACK = TrackConfig(
    num_points=256, num_levels=3, num_keyframes=6, num_sources=2, points_per_source=96, num_hypotheses=32, cell_px=16
)

SETTINGS = [
    f"track.{field.name}={getattr(TRACK, field.name)}"
    for field in fields(TRACK)
    if getattr(TRACK, field.name) != field.default
]
"""The same as overrides of a preset: pictures of this size need no other tracker."""

_SOURCE = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=FRAMES, people=0, path="loop", fps=FPS))
CAMERA = _SOURCE.camera


def room() -> Clip:
    """The recording, rendered once a process; the list of frames is the caller's own."""
    return Clip(_SOURCE, _frames())


@functools.cache
def other_room() -> Clip:
    """The beginning of the same path in a room that looks otherwise."""
    source = SyntheticDataset(
        SyntheticConfig(width=WIDTH, height=HEIGHT, frames=FRAMES, people=0, path="loop", fps=FPS, seed=1)
    )
    return Clip(source, [source[index] for index in range(23)])


@functools.cache
def _frames() -> tuple[Frame, ...]:
    return tuple(_SOURCE[index] for index in range(FRAMES))
