"""Problems of Bundle Adjustment in the Large (Agarwal et al., 2010), and the same solved by Ceres.

A camera there looks along its negative z axis, with y up: p = -P / P.z. Turned half a round about x it is one of ours.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyceres
from scipy.spatial.transform import Rotation

_FLIP = np.diag([1.0, -1.0, -1.0])


class Bal(NamedTuple):
    """A problem as its file has it.

    Attributes:
        cameras: `(k, 9)` rotation vector and translation into the camera, focal length, k1, k2.
        X_world: `(n, 3)` points.
        camera: `(m,)` which camera saw
        point: `(m,)` which point
        uv: `(m, 2)` where.
    """

    cameras: np.ndarray
    X_world: np.ndarray
    camera: np.ndarray
    point: np.ndarray
    uv: np.ndarray


def read_bal(path: Path) -> Bal:
    words = np.array(path.read_text().split(), float)
    k, n, m = words[:3].astype(int)
    rows = words[3 : 3 + 4 * m].reshape(m, 4)
    rest = words[3 + 4 * m :]
    camera, point = rows[:, :2].T.astype(int)
    return Bal(rest[: 9 * k].reshape(k, 9), rest[9 * k :].reshape(n, 3), camera, point, rows[:, 2:])


def our_poses(bal: Bal) -> np.ndarray:
    """`wxyz_xyz` of T_world_cam, `(k, 7)`."""
    into = Rotation.from_matrix(_FLIP @ Rotation.from_rotvec(bal.cameras[:, :3]).as_matrix())
    positions = -into.inv().apply(bal.cameras[:, 3:6] @ _FLIP)
    return np.concatenate([np.roll(into.inv().as_quat(), 1, axis=1), positions], axis=1)


class _Turns:
    """Rotations of the cameras, as nested lists, and what turning them further does; kept until a camera changes."""

    def __init__(self) -> None:
        self._known: dict[bytes, tuple[list, list]] = {}

    def __call__(self, camera: np.ndarray) -> tuple[list, list]:
        key = camera.tobytes()
        if key not in self._known:
            if len(self._known) > 1000:
                self._known.clear()
            R = Rotation.from_rotvec(camera[:3]).as_matrix()
            self._known[key] = R.tolist(), _left_jacobian(camera[:3]).tolist()
        return self._known[key]


class _Cost(pyceres.CostFunction):
    """One observation: plain numbers, for NumPy takes longer over so few."""

    def __init__(self, turns: _Turns, uv: np.ndarray) -> None:
        super().__init__()
        self.turns, self.uv = turns, uv.tolist()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([9, 3])

    def Evaluate(self, parameters, residuals, jacobians):
        (r0, r1, r2), turn = self.turns(parameters[0])
        _, _, _, tx, ty, tz, f, k1, k2 = parameters[0].tolist()
        X, Y, Z = parameters[1].tolist()
        a = r0[0] * X + r0[1] * Y + r0[2] * Z
        b = r1[0] * X + r1[1] * Y + r1[2] * Z
        c = r2[0] * X + r2[1] * Y + r2[2] * Z
        inverse = -1.0 / (c + tz)
        x, y = (a + tx) * inverse, (b + ty) * inverse
        rr = x * x + y * y
        factor = 1.0 + rr * (k1 + k2 * rr)
        residuals[0], residuals[1] = f * factor * x - self.uv[0], f * factor * y - self.uv[1]
        if jacobians is None:
            return True
        straight, growth = f * factor * inverse, 2.0 * f * (k1 + 2.0 * k2 * rr) * inverse
        by_camera: list[float] = []
        by_point: list[float] = []
        for p, u, v in ((x, straight + growth * x * x, growth * x * y), (y, growth * x * y, straight + growth * y * y)):
            w = x * u + y * v  # by the depth: p = -P / P.z
            turned = (v * -c + w * b, u * c - w * a, v * a - u * b)
            by_camera += [sum(turned[i] * turn[i][j] for i in range(3)) for j in range(3)]
            by_camera += [u, v, w, factor * p, f * rr * p, f * rr * rr * p]
            by_point += [u * r0[j] + v * r1[j] + w * r2[j] for j in range(3)]
        for jacobian, values in zip(jacobians, (by_camera, by_point), strict=True):
            if jacobian is not None:
                jacobian[:] = values
        return True


def solve_with_ceres(bal: Bal, max_steps: int, tolerance: float) -> pyceres.SolverSummary:
    """Ceres from the file's start: one thread, sparse Schur complement, squared loss, everything free."""
    cameras, X_world, turns = bal.cameras.copy(), bal.X_world.copy(), _Turns()
    problem, loss = pyceres.Problem(), pyceres.TrivialLoss()
    costs = [_Cost(turns, uv) for uv in bal.uv]
    for cost, camera, point in zip(costs, bal.camera, bal.point, strict=True):
        problem.add_residual_block(cost, loss, [cameras[camera], X_world[point]])
    settings = pyceres.SolverOptions()
    settings.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    settings.max_num_iterations = max_steps
    settings.num_threads = 1
    settings.function_tolerance = tolerance
    settings.logging_type = pyceres.LoggingType.SILENT
    summary = pyceres.SolverSummary()
    pyceres.solve(settings, problem, summary)
    return summary


def _left_jacobian(rotvec: np.ndarray) -> np.ndarray:
    """What a change of a rotation vector turns, in the axes turned into."""
    angle = np.linalg.norm(rotvec)
    K = np.cross(np.eye(3), rotvec / angle)
    return np.eye(3) + (1 - np.cos(angle)) / angle * K + (1 - np.sin(angle) / angle) * K @ K
