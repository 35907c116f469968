"""The figures of the KITTI odometry benchmark, in plain NumPy and one segment after the other.

Source: Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012, and
what `evaluate_odometry` of the development kit does. evo has no such metric.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation


def kitti_drift(
    P: np.ndarray, Q: np.ndarray, lengths: Sequence[float] | np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Errors of each segment, a meter, by length and beginning, 0 where there is none; and how many there are.

    Args:
        P: `(n, 7)` estimated poses, `wxyz_xyz`.
        Q: `(n, 7)` true poses.
        lengths: Of segments, meters.
        step: From one beginning to the next.
    """
    P, Q = _matrices(P), _matrices(Q)
    way = [0.0]
    for before, after in itertools.pairwise(Q):
        way.append(way[-1] + float(np.linalg.norm(after[:3, 3] - before[:3, 3])))
    shape = (len(lengths), -(-len(Q) // step))
    translations, rotations, count = np.zeros(shape), np.zeros(shape), 0
    for k, length in enumerate(lengths):
        for s, first in enumerate(range(0, len(Q), step)):
            last = next((i for i in range(first, len(Q)) if way[i] > way[first] + length), None)
            if last is None:
                continue
            true, estimated = np.linalg.inv(Q[first]) @ Q[last], np.linalg.inv(P[first]) @ P[last]
            E = np.linalg.inv(estimated) @ true
            translations[k, s] = np.linalg.norm(E[:3, 3]) / length
            rotations[k, s] = np.arccos(np.clip((np.trace(E[:3, :3]) - 1) / 2, -1, 1)) / length
            count += 1
    return translations, rotations, count


def _matrices(poses: np.ndarray) -> np.ndarray:
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(poses[:, :4], scalar_first=True).as_matrix()
    T[:, :3, 3] = poses[:, 4:]
    return T
