"""Measured relative poses of keyframes, as arrays of a fixed length for compiled programs."""

from typing import Any

import numpy as np
from jaxlie import SE3
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges
from jaxtyping import Float, Int

from jaxslam.geometry.se3 import IDENTITY
from jaxslam.geometry.types import Poses
from jaxslam.runtime.padding import padded


def padded_edges(
    source: Int[np.ndarray, " e"],
    target: Int[np.ndarray, " e"],
    T_source_target: Poses,
    information: Float[np.ndarray, "e 6 6"],
    room: int,
    dtype: type[np.floating] = np.float32,
) -> PoseGraphEdges:
    """Return edges of weight one in arrays of length `room`.

    Args:
        source: `(e,)` rows of the keyframes in whose frame is measured.
        target: `(e,)` rows of the keyframes that are measured.
        T_source_target: `(e, 7)` measured relative poses.
        information: `(e, 6, 6)` inverse covariances of the measurements: translation (m), then rotation (rad).
        room: Length of the arrays, at least e.
        dtype: Floating-point type of the arrays.
    """
    num = len(source)
    poses: Any = padded(T_source_target, room, fill=IDENTITY).astype(dtype)
    columns: Any = (
        padded(source, room).astype(np.int32),
        padded(target, room).astype(np.int32),
        SE3(poses),
        padded(information, room, fill=np.eye(6)).astype(dtype),
        padded(np.ones(num, dtype), room),
        np.arange(room) < num,
    )
    return PoseGraphEdges(*columns)
