"""Types of host arrays that many modules share: poses, rotations, points, pixels, ids and timestamps.

Their lengths are anonymous (`_n`), so that two arguments of one type may differ in length. A function whose arguments
must have the same length writes their types out.
"""

from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Float64, Int, Int64

Pose: TypeAlias = Float64[np.ndarray, "7"]
"""A rigid transform `wxyz_xyz`: a unit quaternion and a translation in meters."""

Poses: TypeAlias = Float64[np.ndarray, "_n 7"]
"""Rigid transforms `wxyz_xyz`, one per row."""

Transforms: TypeAlias = Float[np.ndarray, "... 7"]
"""Rigid transforms `wxyz_xyz` of any precision, with any number of batch dimensions."""

Quaternions: TypeAlias = Float[np.ndarray, "... 4"]
"""Unit quaternions `wxyz` of any precision, with any number of batch dimensions."""

Positions: TypeAlias = Float[np.ndarray, "_n 3"]
"""Positions, one per row, meters."""

Points: TypeAlias = Float[np.ndarray, "3 _n"]
"""Points, one per column, meters."""

Pixels: TypeAlias = Float[np.ndarray, "2 _n"]
"""Image coordinates `u, v`, one point per column, pixels; the center of the top-left pixel is (0, 0)."""

Ids: TypeAlias = Int[np.ndarray, " _n"]
"""Ids of keyframes or of map points."""

Timestamps: TypeAlias = Int64[np.ndarray, " _n"]
"""Times, nanoseconds."""
