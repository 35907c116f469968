"""The ways a camera can move through a rendered room, by name; apart from the renderer, which needs JAX."""

from typing import Literal, TypeAlias

CameraPathKind: TypeAlias = Literal["xyz", "rpy", "halfsphere", "static", "loop"]
"""`xyz` moves along the axes, `rpy` turns in place, `halfsphere` sweeps half a sphere of one meter diameter, `static`
is held still, `loop` goes once round the desk in the middle of the room every `camera_path.LOOP_SECONDS`."""
