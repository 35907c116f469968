"""Types of host arrays that many modules share: poses, rotations, points, pixels, ids and timestamps."""

from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Float64, Int, Int64

Pose: TypeAlias = Float64[np.ndarray, "7"]
"""A rigid transform `wxyz_xyz`: a unit quaternion and a translation in meters."""

Poses: TypeAlias = Float64[np.ndarray, "n 7"]
"""Rigid transforms, one a row, as in `Pose`."""

Transforms: TypeAlias = Float64[np.ndarray, "*batch 7"]
"""Rigid transforms in any number of batch dimensions, as in `Pose`."""

Quaternions: TypeAlias = Float64[np.ndarray, "*batch 4"]
"""Unit quaternions `wxyz` in any number of batch dimensions."""

Positions: TypeAlias = Float[np.ndarray, "n 3"]
"""Positions, one a row, meters."""

Points: TypeAlias = Float[np.ndarray, "3 n"]
"""Coordinates of points, one a column, meters."""

Pixels: TypeAlias = Float[np.ndarray, "2 n"]
"""Image coordinates `u, v`, one point a column, pixels; the center of the top-left pixel is (0, 0)."""

Ids: TypeAlias = Int[np.ndarray, " n"]
"""Ids of keyframes or of map points."""

Timestamps: TypeAlias = Int64[np.ndarray, " n"]
"""Times, nanoseconds."""
