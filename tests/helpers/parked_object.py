"""A box that stands, is pushed, and stands again, and what the tracker takes it for in every frame."""

from typing import NamedTuple

import numpy as np

from jaxslam import Slam, load_config
from jaxslam.datasets.synthetic import SceneDetector, SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.parked_boxes import is_moving

WITHIN = 5
"""Frames after which a change is to be known."""


class Verdicts(NamedTuple):
    """Of the frames of a recording.

    Attributes:
        moves: `(n,)` whether the box moves from the frame before to this one.
        masked: `(n,)` share of the pixels that show it which are left out.
        error_m: `(n,)` distance between tracked and true position of the camera, meters.
    """

    moves: np.ndarray
    masked: np.ndarray
    error_m: np.ndarray

    @property
    def said(self) -> np.ndarray:
        """`(n,)` whether it is taken to move."""
        return self.masked > 0.5

    def changes(self) -> list[int]:
        """The first frame of each stretch in which it does the same, but for the first."""
        return [int(frame) + 1 for frame in np.flatnonzero(np.diff(self.moves))]

    def known_after(self, change: int) -> int | None:
        """Frames until the verdict is right after a change; `None` if it is not before the next."""
        ends = [other for other in (*self.changes(), len(self.moves)) if other > change]
        right = np.flatnonzero(self.said[change : ends[0]] == self.moves[change])
        return int(right[0]) if right.size else None

    def wrong_share(self, grace: int) -> float:
        """Share of wrong verdicts, the first `grace` frames after a beginning or a change left out."""
        late = np.zeros(len(self.moves), bool)
        for change in (0, *self.changes()):
            late[change : change + grace] = True
        return float(np.mean((self.said != self.moves)[~late]))


def verdicts(
    seed: int, preset: str = "usd", *, start: int = 0, stop: int = 450, path: str = "xyz", **room: int
) -> Verdicts:
    """Track a part of the recording with true masks of the box, whatever it does."""
    config = load_config(preset, overrides=("semantics.model=scene", "semantics.labels=[person, box]"))
    scene = SyntheticConfig(frames=stop, people=0, parked=1, path=path, seed=seed, **room)  # type: ignore[arg-type]
    data = SyntheticDataset(scene)
    detector = SceneDetector(data, labels=config.semantics.labels)
    masked, pose = [], []
    with Slam(data.camera, config, detector=detector) as slam:
        for index in range(start, stop):
            rendered = data.render(index)
            detector.note(rendered)
            tracked, shows = slam.track(rendered.measured), rendered.instance_mask > 0
            masked.append(tracked.dynamic_mask[shows].mean() if shows.any() else 0.0)
            pose.append(tracked.T_world_cam)
    time_s = (data.timestamps_ns[start:stop] - data.timestamps_ns[0]) * 1e-9
    moves = is_moving(np.maximum(time_s - 0.5 / data.fps, 0))  # on the way from the frame before
    true = data.T_world_cam[start:stop, 4:]
    return Verdicts(moves, np.array(masked), _error(np.array(pose)[:, 4:], true))


def _error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distance of positions after rigid alignment."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = (u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    return np.linalg.norm(a @ rotation.T - b, axis=1)
