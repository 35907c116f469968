"""Every public kernel with numbers that have derivatives: by which arguments, which are constant, and singular cases.

The tests compare all of it with differences, and `docs/make_tables.py` makes the table of `docs/derivatives.md` of it.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels import camera, robust, rolling_shutter
from jaxslam_kernels import scene_flow as motion
from jaxslam_kernels import se3 as transform
from jaxslam_kernels.bundle import bundle_adjust
from jaxslam_kernels.bundle import cost as bundle_cost
from jaxslam_kernels.clustering import dbscan, kmeans
from jaxslam_kernels.depth import depth_change, free_space, voxel_grid, voxel_hash
from jaxslam_kernels.depth import sampling as depth_image
from jaxslam_kernels.flow import disparity, lk_flow, patch_align
from jaxslam_kernels.flow.lk_flow import FlowPlan
from jaxslam_kernels.flow.lk_search import LevelPlan
from jaxslam_kernels.image import corners
from jaxslam_kernels.image import pyramid as image
from jaxslam_kernels.point_network import PointNetwork, network_shapes, score_points
from jaxslam_kernels.pose import absolute_orientation, p3p, pnp, pose_refine
from jaxslam_kernels.pose.pose_cost import PosePrior, PoseProblem
from jaxslam_kernels.pose_graph import pose_graph
from jaxslam_kernels.ransac_sampling import draw_samples
from jaxslam_kernels.trajectory import alignment
from jaxslam_kernels.trajectory import kitti_drift as segments
from jaxslam_kernels.two_view import epipolar, fundamental
from quick_compile import quick_compile
from small_problems import CAMERA, bundle_inputs, graph_inputs, match_inputs, pose_inputs


class DerivativeCase(NamedTuple):
    """A kernel with numbers at which it has derivatives.

    Attributes:
        call: The kernel with everything bound that is no floating-point number.
        carries: Arguments by which results have a first and a second derivative, by name. A name may go on after a
            colon, where only a part of the argument is meant.
        constants: Arguments by which the derivative is zero, by name.
        not_meant: Arguments of kernels that only search, whose results are constant wherever they are used.
        constant_results: Names of floating-point results that are constant.
        near: Singular cases: by name, what is called in place of `call` (`None`: `call`), and with which `carries`.
        steps: Lengths of the differences, as shares of each argument's size: long ones miss curvature, short ones
            drown in noise, and one of them has to agree.
        noise: Relative error of the results, by which differences are off: solvers end where a step is as small as the
            root of the precision.
    """

    call: Callable[..., Any]
    carries: dict[str, Any]
    constants: dict[str, Any] = {}  # noqa: RUF012 - a NamedTuple has no default factory; nobody changes it
    not_meant: dict[str, Any] = {}  # noqa: RUF012
    constant_results: tuple[str, ...] = ()
    near: Mapping[str, tuple[Callable[..., Any] | None, dict[str, Any]]] = {}
    steps: tuple[float, ...] = (1e-5, 1e-7)
    noise: float = 1e-15

    @property
    def is_choice(self) -> bool:
        """True if nothing in the result has a derivative."""
        return not self.carries


class Maker(NamedTuple):
    """Makes the case of a kernel when it is needed, in float64.

    Attributes:
        make: What makes it.
        slow: Whether its test takes ten seconds or more.
    """

    make: Callable[[], DerivativeCase]
    slow: bool


MAKERS: dict[str, Maker] = {}
"""By name of the kernel."""


def maker(name: str, slow: bool = False) -> Callable[[Callable[[], DerivativeCase]], None]:
    """Register what makes the case of a kernel."""

    def register(make: Callable[[], DerivativeCase]) -> None:
        MAKERS[name] = Maker(make, slow)

    return register


N = 5


def _random(*shape: int, seed: int = 0, low: float = -1.0, high: float = 1.0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, shape))


_exponentials = quick_compile(jax.vmap(lambda tangent: SE3.exp(tangent).wxyz_xyz))


def _poses(n: int, seed: int = 0, size: float = 0.4) -> SE3:
    tangents = size * np.random.default_rng(seed).normal(size=(n, 6))
    return SE3(_exponentials(jnp.asarray(tangents)))


def _pose(seed: int = 0, size: float = 0.4) -> SE3:
    return SE3(_poses(1, seed, size).wxyz_xyz[0])


def _points(n: int = N, seed: int = 1) -> jax.Array:
    """Points in front of a camera."""
    return jnp.asarray(np.random.default_rng(seed).uniform([-1, -1, 2], [1, 1, 5], (n, 3)).T)


def _pixels(n: int = N, seed: int = 2) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).uniform([20, 20], [140, 100], (n, 2)).T)


def _lens(*distortion: float) -> camera.Intrinsics:
    return camera.make_intrinsics(*CAMERA, distortion or (0.1, -0.05, 0.001, 0.002, 0.01), dtype=jnp.float64)


def _simple(
    kernel: Callable[..., Any],
    carries: dict[str, Any],
    constants: dict[str, Any] | None = None,
    near: dict[str, dict[str, Any]] | None = None,
    bound: dict[str, Any] | None = None,
    **more: Any,
) -> DerivativeCase:
    """Make a case whose arguments are those of the kernel; `near` says which values differ from `carries`."""
    call, constants = partial(kernel, **(bound or {})), constants or {}
    changed = {name: (None, carries | values) for name, values in (near or {}).items()}
    return DerivativeCase(call, carries, constants, near=changed, **more)


# ---- cameras and transforms


@maker("without_distortion")
def _() -> DerivativeCase:
    return _simple(camera.without_distortion, {"intrinsics": _lens()})


@maker("in_front")
def _() -> DerivativeCase:
    return _simple(camera.in_front, {}, {"X_cam": _points()})


@maker("project")
def _() -> DerivativeCase:
    close = _points().at[:, 0].set(jnp.array([0.002, -0.003, 0.02]))  # twice as far as is imaged
    return _simple(
        camera.project,
        {"intrinsics": _lens(), "X_cam": _points()},
        near={"points near the camera": {"X_cam": close}},
    )


@maker("back_project")
def _() -> DerivativeCase:
    return _simple(
        camera.back_project,
        {"intrinsics": _lens(), "uv": _pixels(), "depth": _random(N, low=1, high=4)},
        near={"depths near 0": {"depth": _random(N, low=1e-4, high=1e-3)}},
    )


@maker("to_pixels")
def _() -> DerivativeCase:
    return _simple(camera.to_pixels, {"intrinsics": _lens(), "xy": _random(2, N)})


@maker("distort")
def _() -> DerivativeCase:
    return _simple(
        camera.distort,
        {"intrinsics": _lens(), "xy": _random(2, N)},
        near={"the optical axis": {"xy": 1e-6 * _random(2, N)}},
    )


@maker("normalize")
def _() -> DerivativeCase:
    wide = camera.make_intrinsics(110.0, 112.0, 80.0, 60.0, (-0.3, 0.06, 0.001, -0.001, 0.0), dtype=jnp.float64)
    corner = jnp.array([[2.0, 158, 10], [3.0, 5, 117]])
    return _simple(
        camera.normalize,
        {"intrinsics": _lens(), "uv": _pixels(3)},
        near={"corners of a wide image": {"intrinsics": wide, "uv": corner}},
    )


@maker("undistort_pixels")
def _() -> DerivativeCase:
    return _simple(camera.undistort_pixels, {"intrinsics": _lens(), "uv": _pixels()})


@maker("depth_from_disparity")
def _() -> DerivativeCase:
    values = {"disparity": _random(N, low=3, high=20), "fx": jnp.array(200.0), "baseline": jnp.array(0.1)}
    near = {"disparities near 0": {"disparity": _random(N, low=0.1, high=0.2)}}
    return _simple(camera.depth_from_disparity, values, near=near)


@maker("disparity_from_depth")
def _() -> DerivativeCase:
    values = {"depth": _random(N, low=1, high=5), "fx": jnp.array(200.0), "baseline": jnp.array(0.1)}
    return _simple(
        camera.disparity_from_depth, values, near={"depths near 0": {"depth": _random(N, low=0.1, high=0.2)}}
    )


@maker("retract")
def _() -> DerivativeCase:
    tangent = 0.5 * _random(6, seed=3)
    near = {
        "no motion": {"tangent_b": jnp.zeros(6)},
        "the change of formulas": {"tangent_b": tangent.at[3:].set(jnp.array([0.4999, 0.001, 0.002]))},
    }
    return _simple(transform.retract, {"T_a_b": _pose(), "tangent_b": tangent}, near=near)


@maker("compose")
def _() -> DerivativeCase:
    return _simple(transform.compose, {"T_a_b": _poses(2), "T_b_c": _poses(2, 1)})


@maker("between")
def _() -> DerivativeCase:
    return _simple(transform.between, {"T_world_a": _poses(2), "T_world_b": _poses(2, 1)})


@maker("displacement")
def _() -> DerivativeCase:
    a = _pose()
    near = {
        "hardly a motion": {"T_world_b": transform.retract(a, 1e-5 * _random(6, seed=4))},
        "no motion": {"T_world_b": a},
        "nearly half a turn": {"T_world_b": transform.retract(a, jnp.array([0.1, 0, 0.2, 0, 3.1, 0.1]))},
    }
    return _simple(transform.displacement, {"T_world_a": a, "T_world_b": _pose(1)}, near=near)


@maker("rotation_matrix")
def _() -> DerivativeCase:
    return _simple(transform.rotation_matrix, {"T_a_b": _pose()})


@maker("to_camera")
def _() -> DerivativeCase:
    return _simple(transform.to_camera, {"T_world_cam": _pose(), "X_world": _points()})


@maker("to_world")
def _() -> DerivativeCase:
    return _simple(transform.to_world, {"T_world_cam": _pose(), "X_cam": _points()})


@maker("cross_matrix")
def _() -> DerivativeCase:
    return _simple(transform.cross_matrix, {"v": _random(3)})


@maker("usable_pose")
def _() -> DerivativeCase:
    far = SE3(_pose().wxyz_xyz * jnp.array([3.0, 3, 3, 3, 1, 1, 1]))
    return _simple(pose_refine.usable_pose, {"T": _pose()}, near={"a quaternion that is not of length one": {"T": far}})


@maker("usable_poses")
def _() -> DerivativeCase:
    return _simple(alignment.usable_poses, {"T": _poses(3)})


@maker("image_velocity")
def _() -> DerivativeCase:
    values = {"xy": _random(2, N), "depth": _random(N, low=1, high=4), "twist": _random(6)}
    return _simple(
        rolling_shutter.image_velocity, values, near={"points near the camera": {"depth": jnp.full(N, 0.02)}}
    )


@maker("row_time")
def _() -> DerivativeCase:
    values = {"v": _random(N, low=0, high=39), "readout_s": jnp.array(0.02)}
    return _simple(rolling_shutter.row_time, values, bound={"height": 40})


@maker("as_if_at_once")
def _() -> DerivativeCase:
    values = {
        "xy": _random(2, N),
        "velocity": _random(2, N, seed=1),
        "v": _random(N, low=0, high=39),
        "readout_s": jnp.array(0.02),
    }
    return _simple(rolling_shutter.as_if_at_once, values, bound={"height": 40})


# ---- robust statistics and motion


def _loss_case(kernel: Callable[..., Any]) -> DerivativeCase:
    """Huber's loss: below and above its corner, and next to it on both sides; the others at the same residuals."""
    values = {"squared": jnp.array([0.3, 1.7, 5.9, 30.0]), "scale": jnp.array(2.0)}
    border, zero = ({"squared": jnp.array(squared)} for squared in ([3.97, 4.03], [1e-9]))
    near = {"Huber's corner": border, "residual 0": zero}
    case = _simple(kernel, values, bound={"loss": "huber"}, near=near)
    others = {
        f"`{loss}`": (partial(kernel, loss=loss), values | {"squared": jnp.array([1e-9, 1.7, 3.97, 4.03, 30.0])})
        for loss in ("cauchy", "geman_mcclure")
    }
    return case._replace(near={**case.near, **others})


@maker("loss_value")
def _() -> DerivativeCase:
    return _loss_case(robust.loss_value)


@maker("loss_weight")
def _() -> DerivativeCase:
    return _loss_case(robust.loss_weight)


@maker("weighted_median")
def _() -> DerivativeCase:
    return _simple(robust.weighted_median, {"values": _random(7)}, {"weights": _random(7, low=0.5)})


@maker("masked_median")
def _() -> DerivativeCase:
    return _simple(robust.masked_median, {"values": _random(7)}, bound={"mask": jnp.ones(7, bool)})


@maker("robust_scale")
def _() -> DerivativeCase:
    return _simple(robust.robust_scale, {"residuals": _random(7)}, {"weights": _random(7, low=0.5)})


@maker("scene_flow")
def _() -> DerivativeCase:
    values = {"X_world": _points(), "X_cam": _points(seed=2), "T_world_cam": _pose()}
    return _simple(motion.scene_flow, values)


@maker("flow_length")
def _() -> DerivativeCase:
    return _simple(motion.flow_length, {"flow": _random(3, N)}, near={"length 0": {"flow": 1e-4 * _random(3, N)}})


@maker("upper_limit")
def _() -> DerivativeCase:
    values = {"intensity": _random(7, low=0.1), "sigmas": jnp.array(3.0)}
    return _simple(motion.upper_limit, values, {"weights": _random(7, low=0.5)})


@maker("group_motion")
def _() -> DerivativeCase:
    bound = {"counts": jnp.ones(6, bool), "group": jnp.array([0, 1, 0, 1, 0, 1], jnp.int32), "num_groups": 2}
    return _simple(motion.group_motion, {"flow": _random(3, 6), "moves": _random(6, low=0.2)}, bound=bound)


# ---- poses

_SOLVER_STEPS, _SOLVER_NOISE = (1e-3, 2e-4, 4e-5), 3e-9


def _triangles(seed: int = 0, flat: float = 1.0) -> jax.Array:
    """Two triangles; `flat` is by how much their third corner is off the line of the others."""
    corner = np.random.default_rng(seed).uniform(-1, 1, (3, 3, 2))
    corner[:, 2] = 0.5 * (corner[:, 0] + corner[:, 1]) + flat * corner[:, 2]
    return jnp.asarray(corner)


@maker("absolute_orientation")
def _() -> DerivativeCase:
    def moved(source: jax.Array) -> jax.Array:
        R, t = _pose(2).rotation().as_matrix(), jnp.array([0.1, 0.2, 0.3])
        return jnp.einsum("ij,jkh->ikh", R, source) + t[:, None, None] + 0.003 * _random(3, 3, 2, seed=5)

    source, flat = _triangles(), _triangles(flat=0.02)
    return _simple(
        absolute_orientation.absolute_orientation,
        {"source": source, "target": moved(source)},
        near={"corners nearly on a line": {"source": flat, "target": moved(flat)}},
    )


def _bearings() -> dict[str, Any]:
    X_cam = _points(3)
    bearing = X_cam / jnp.linalg.norm(X_cam, axis=0, keepdims=True)
    T = _pose(1)
    return {"bearings": bearing[:, :, None], "X_world": transform.to_world(T, X_cam)[:, :, None]}


@maker("p3p")
def _() -> DerivativeCase:
    return DerivativeCase(p3p.p3p, {}, not_meant=_bearings())


@maker("p3p_near")
def _() -> DerivativeCase:
    distances = jnp.linalg.norm(_points(3), axis=0)[:, None]
    return _simple(p3p.p3p_near, _bearings(), {"distances": distances})


def _views(n: int = 12, **more: Any) -> dict[str, Any]:
    """Inputs of `refine_pose` that have derivatives."""
    T, X_world, uv = pose_inputs(n)
    depth = transform.to_camera(T, X_world)[2] * (1 + 0.01 * _random(n, seed=6))
    prior = PosePrior(transform.retract(T, 0.02 * _random(6, seed=7)), 100.0 * jnp.eye(6) + 10.0)
    return {
        "X_world": X_world,
        "uv": uv,
        "intrinsics": _lens(),
        "weights": _random(n, low=0.5, high=1.5, seed=8),
        "depth": depth,
        "sigma_px": _random(n, low=0.8, high=1.2, seed=9),
        "scale": jnp.array(2.0),
        "prior": prior,
    } | more


def _without(values: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in names}


@maker("refine_pose", slow=True)
def _() -> DerivativeCase:
    T, X_world, _ = pose_inputs(12)
    call = partial(pose_refine.refine_pose, max_steps=200)
    values, camera_pose = _views(), T
    seen = lambda X: camera.project(_lens(), transform.to_camera(camera_pose, X)) + 0.2 * _random(2, 12, seed=13)
    unknown = {"depth": -jnp.ones(12), "prior": PosePrior(T, 1e-6 * jnp.eye(6))}  # all but no prior
    few = X_world.at[2, 3:].multiply(-1.0)  # all but three are behind the camera
    plane = X_world.at[2].set(3.0 + 0.3 * X_world[0] + 0.003 * _random(12, seed=10))
    line = jnp.stack([jnp.linspace(-1, 1, 12), 0.02 * _random(12, seed=11), 3 + 0.02 * _random(12, seed=12)])
    aside = 1.98 * (-1.0) ** jnp.arange(12.0)  # in standard deviations, of which the scale of the loss is two
    border = camera.project(_lens(), transform.to_camera(T, X_world)).at[0].add(aside)
    equal = {"weights": jnp.ones(12), "sigma_px": jnp.ones(12)}
    return DerivativeCase(
        call,
        values,
        {"T_world_cam": T},
        near={
            "three points": (None, values | {"X_world": few, "prior": unknown["prior"]}),
            "points nearly in a plane": (None, values | unknown | {"X_world": plane, "uv": seen(plane)}),
            "points nearly on a line": (None, values | unknown | {"X_world": line, "uv": seen(line)}),
            "residuals at the border of the robust weight": (None, values | equal | {"uv": border}),
            "Huber's corner": (partial(call, loss="huber"), values | {"scale": jnp.array(0.7)}),
        },
        steps=_SOLVER_STEPS,
        noise=_SOLVER_NOISE,
    )


@maker("ransac_pnp", slow=True)
def _() -> DerivativeCase:
    T, *_ = pose_inputs(12)
    bound = {"key": jax.random.key(0), "num_hypotheses": 4, "min_inliers": 4, "max_steps": 200, "loss": "cauchy"}
    values = _without(_views(), "sigma_px", "scale")
    constants = {"initial": T}
    return _simple(
        pnp.ransac_pnp,
        values | {"threshold_px": jnp.array(4.0)},
        constants,
        bound=bound,
        constant_results=("score",),
        steps=_SOLVER_STEPS,
        noise=_SOLVER_NOISE,
    )


@maker("score_poses")
def _() -> DerivativeCase:
    T, X_world, uv = pose_inputs(N)
    near_T = [transform.retract(T, t) for t in 0.002 * _random(2, 6, seed=3)]
    R = jnp.stack([transform.rotation_matrix(each).T for each in near_T], -1)
    t = -jnp.einsum("ijh,jh->ih", R, jnp.stack([each.translation() for each in near_T], -1))
    matrices = jnp.concatenate([R, t[:, None]], axis=1)
    problem = PoseProblem(
        X_world,
        camera.normalize(_lens(0.0), uv),
        X_world[2],
        jnp.ones((3, N)) * jnp.array([[200.0], [210.0], [0.0]]),
        _random(N, low=0.5, high=1.5),
        jnp.array(8.0),
        None,
    )
    return _simple(pnp.score_poses, {"T_cam_world": matrices, "problem": problem})


@maker("draw_samples")
def _() -> DerivativeCase:
    bound = {"key": jax.random.key(0), "num_samples": 3, "size": 4}
    return _simple(draw_samples, {}, {"weights": _random(8, low=0.5)}, bound=bound)


# ---- many poses


@maker("observe")
def _() -> DerivativeCase:
    index = jnp.arange(N, dtype=jnp.int32)
    values = {
        "uv": _pixels(),
        "intrinsics": _lens(),
        "depth": _random(N, low=1, high=4),
        "sigma_px": _random(N, low=0.8, high=1.2),
        "sigma_depth": jnp.array(0.02),
        "weights": _random(N, low=0.5),
    }
    return _simple(bundle_cost.observe, values, bound={"camera": 0 * index, "point": index, "valid": index >= 0})


def _relative(edges: Any) -> dict[str, Any]:
    """The floating-point part of the edges of a graph."""
    return {"T": edges.T_source_target.wxyz_xyz, "information": edges.information, "weights": edges.weights}


def _with_edges(edges: Any, values: dict[str, Any]) -> Any:
    pose = SE3(values["T"])
    return edges._replace(T_source_target=pose, information=values["information"], weights=values["weights"])


@maker("bundle_adjust", slow=True)
def _() -> DerivativeCase:
    def of(inputs: Any) -> tuple[Callable[..., Any], dict[str, Any], dict[str, Any]]:
        free, n = np.array([False, False, True]), inputs.X_world.shape[1]
        (_, graph), poses = graph_inputs(), inputs.poses
        edges = jax.tree.map(lambda array: array[:2], graph)._replace(
            source=jnp.array([0, 1]), target=jnp.array([2, 2]), weights=jnp.array([0.4, 0.3])
        )
        measured = jax.vmap(lambda a: transform.between(SE3(a), SE3(poses[2])).wxyz_xyz)(poses[:2])
        edges = edges._replace(T_source_target=SE3(measured))

        def call(**values: Any) -> Any:
            of_poses = jnp.where(free[:, None], values.get("poses: free", poses), values["poses: fixed"])
            first = jnp.arange(n) == 0
            X_world = jnp.where(first, values["X_world: fixed"], values.get("X_world: free", inputs.X_world))
            observed = inputs.observations._replace(**values["observations"])
            return bundle_adjust.bundle_adjust(
                of_poses,
                X_world,
                observed,
                fixed_poses=jnp.asarray(~free),
                fixed_points=first,
                point_weights=values["point_weights"],
                edges=_with_edges(edges, values["edges"]),
                scale=values["scale"],
                tolerance=values.get("tolerance", jnp.array(0.0)),
                max_steps=100,
            )

        seen = inputs.observations
        carries = {
            "poses: fixed": poses,
            "X_world: fixed": inputs.X_world,
            "observations": {
                "xy": seen.xy,
                "precision": seen.precision,
                "weights": _random(seen.weights.shape[0], low=0.5),
            },
            "point_weights": _random(n, low=0.5),
            "edges": _relative(edges),
            "scale": jnp.array(2.0),
        }
        constants = {"poses: free": poses, "X_world: free": inputs.X_world, "tolerance": jnp.array(0.0)}
        return call, carries, constants

    call, carries, constants = of(bundle_inputs(5))
    return DerivativeCase(
        call,
        carries,
        constants,
        constant_results=("initial_cost",),
        steps=_SOLVER_STEPS,
        noise=_SOLVER_NOISE,
    )


@maker("optimize_pose_graph", slow=True)
def _() -> DerivativeCase:
    start, edges = graph_inputs()
    fixed = np.array([True, False, False, False])

    def call(loss: str = "cauchy", **values: Any) -> Any:
        nodes = values.get("T_world_cam: free", start.wxyz_xyz)
        return pose_graph.optimize_pose_graph(
            SE3(jnp.where(fixed[:, None], values["T_world_cam: fixed"], nodes)),
            _with_edges(edges, values["edges"]),
            jnp.asarray(fixed),
            loss=loss,  # pyright: ignore[reportArgumentType] - a name of a loss
            loss_scale=values["loss_scale"],
            group_size=16,
        )

    values = {"T_world_cam: fixed": start.wxyz_xyz, "edges": _relative(edges), "loss_scale": jnp.array(1.0)}
    tree = values["edges"] | {"weights": jnp.array([1.0, 1.0, 0.05, 0.05, 0.05, 1.0])}
    return DerivativeCase(
        call,
        values,
        {"T_world_cam: free": start.wxyz_xyz},
        constant_results=("cost_before",),
        near={"hardly a loop": (None, values | {"edges": tree})},
        steps=(5e-3, 1e-3),
        noise=1e-8,
    )


# ---- two views


def _two_views(n: int = N) -> dict[str, Any]:
    F = epipolar.fundamental_of_poses(_pose(1, 0.2), _pose(2, 0.2), _lens(0.0))
    return {"F": F / jnp.linalg.norm(F), "uv_before": _pixels(n), "uv_after": _pixels(n, 3)}


@maker("epipolar_distances")
def _() -> DerivativeCase:
    return _simple(epipolar.epipolar_distances, _two_views())


@maker("sampson_distances")
def _() -> DerivativeCase:
    return _simple(epipolar.sampson_distances, _two_views())


@maker("sampson_squared")
def _() -> DerivativeCase:
    F = jnp.stack([_two_views()["F"], _random(3, 3)], axis=-1)[..., None]
    return _simple(epipolar.sampson_squared, {"F": F, "before": _pixels(), "after": _pixels(seed=3)})


@maker("fundamental_of_poses")
def _() -> DerivativeCase:
    before = _pose(1)
    values = {"T_world_before": before, "T_world_after": _pose(2), "intrinsics": _lens(0.0)}
    hardly = {"T_world_after": transform.retract(before, jnp.array([1e-4, 0, 0, 0.2, 0, 0]))}
    return _simple(epipolar.fundamental_of_poses, values, near={"hardly a baseline": hardly})


@maker("seven_point")
def _() -> DerivativeCase:
    before, after = match_inputs(7)
    pixels = {"uv_before": before[:, :, None], "uv_after": after[:, :, None]}
    return DerivativeCase(epipolar.seven_point, {}, not_meant=pixels)


@maker("adjugate")
def _() -> DerivativeCase:
    return _simple(epipolar.adjugate, {"F": _random(3, 3, 2)})


@maker("ransac_fundamental", slow=True)
def _() -> DerivativeCase:
    before, after = match_inputs()
    bound = {"key": jax.random.key(0), "num_hypotheses": 16, "num_improved": 0, "max_steps": 200}
    return _simple(
        fundamental.ransac_fundamental,
        {
            "uv_before": before,
            "uv_after": after,
            "weights": _random(20, low=0.7, high=1.3),
            "threshold_px": jnp.array(3.0),
        },
        bound=bound,
        constant_results=("score",),
        steps=(1e-4, 1e-5),
        noise=_SOLVER_NOISE,
    )


# ---- images


def _texture(shift: float = 0.0, height: int = 40, width: int = 48) -> jax.Array:
    v, u = np.mgrid[:height, :width].astype(float)
    return jnp.asarray(128 + 40 * np.sin(0.35 * (u + shift)) + 30 * np.cos(0.29 * v) + 20 * np.sin(0.2 * u + 0.31 * v))


_CENTERS = np.array([[17.3, 22.6], [20.7, 18.2]])
_TO_THE_END = LevelPlan(9, 60, 1e-9)
_PLAN = FlowPlan(_TO_THE_END, _TO_THE_END, _TO_THE_END)
_IMAGE_STEPS = (1e-5,)  # of an image of some hundred: between pixels, interpolation bends


@maker("corner_score")
def _() -> DerivativeCase:
    return _simple(corners.corner_score, {"image": _texture(height=14, width=14)})


@maker("grid_corners")
def _() -> DerivativeCase:
    bound = {"allowed": jnp.ones((12, 12), bool), "cell": 4}
    return _simple(corners.grid_corners, {}, {"score": _random(12, 12, low=0.1)}, bound=bound)


@maker("occupied_cells")
def _() -> DerivativeCase:
    bound = {"valid": jnp.ones(3, bool), "shape": (40, 48), "cell": 8}
    return _simple(corners.occupied_cells, {}, {"points": _pixels(3)}, bound=bound)


@maker("half_size")
def _() -> DerivativeCase:
    return _simple(image.half_size, {"image": _texture(height=12, width=16)})


@maker("build_pyramid")
def _() -> DerivativeCase:
    return _simple(image.build_pyramid, {"image": _texture(height=16, width=16)}, bound={"num_levels": 2})


def _stripes(shift: float) -> jax.Array:
    """A texture that is a hundred times weaker along one direction."""
    v, u = np.mgrid[:40, :48].astype(float)
    return jnp.asarray(128 + 60 * np.sin(0.35 * (u + shift)) + 3.0 * np.cos(0.29 * v + 0.02 * u))


def _flow_case(kernel: Callable[..., Any], **constants: Any) -> DerivativeCase:
    def call(**values: Any) -> Any:
        pyramids = [image.build_pyramid(values.pop(name), num_levels=1) for name in ("previous", "current")]
        return kernel(*pyramids, **values, plan=_PLAN, min_texture=0.01)

    values = {"previous": _texture(), "current": _texture(0.7), "points": jnp.asarray(_CENTERS)}
    weak = {"previous": _stripes(0.0), "current": _stripes(0.4)}
    near = {"a texture of stripes": (None, values | weak)}
    return DerivativeCase(call, values, constants, near=near, steps=_IMAGE_STEPS)


@maker("lk_flow", slow=True)
def _() -> DerivativeCase:
    return _flow_case(lk_flow.lk_flow, guess=jnp.asarray(_CENTERS) + 0.2)


@maker("lk_flow_forward_backward", slow=True)
def _() -> DerivativeCase:
    return _flow_case(lk_flow.lk_flow_forward_backward, expected_px=jnp.array(0.0))


@maker("warped_patches")
def _() -> DerivativeCase:
    values = {"pictures": _texture()[None], "center": jnp.asarray(_CENTERS), "warp": _warp()}
    bound = {"picture": jnp.zeros(2, jnp.int32), "side": 5, "stride": 8}
    return _simple(patch_align.warped_patches, values, bound=bound, steps=_IMAGE_STEPS)


def _warp() -> jax.Array:
    return jnp.eye(2)[:, :, None] + 0.02 * _random(2, 2, 2, seed=4)


@maker("align_patches", slow=True)
def _() -> DerivativeCase:
    def call(**values: Any) -> Any:
        current = image.build_pyramid(values.pop("current"), num_levels=1)
        search: Callable[..., Any] = partial(patch_align.align_patches, mask=jnp.ones(2, bool), plan=_TO_THE_END)
        return search(current=current, picture=jnp.zeros(2, jnp.int32), **values)

    values = {"pictures": _texture()[None], "current": _texture(0.7), "center": jnp.asarray(_CENTERS), "warp": _warp()}
    constants = {"guess": jnp.asarray(_CENTERS), "min_texture": jnp.array(0.1)}
    weak = {"pictures": _stripes(0.0)[None], "current": _stripes(0.4)}
    near = {"a texture of stripes": (None, values | weak)}
    return DerivativeCase(call, values, constants, near=near, steps=_IMAGE_STEPS)


@maker("row_disparities", slow=True)
def _() -> DerivativeCase:
    def call(**values: Any) -> Any:
        pyramids = [image.build_pyramid(values.pop(name), num_levels=1) for name in ("left", "right")]
        plan = disparity.ROW_PLAN._replace(finest=_TO_THE_END)
        search: Callable[..., Any] = disparity.row_disparities
        return search(*pyramids, mask=jnp.ones(2, bool), plan=plan, **values)

    values = {"left": _texture(), "right": _texture(2.3), "points": jnp.asarray(_CENTERS)}
    return DerivativeCase(call, values, {"guess": jnp.full(2, 2.0), "least": jnp.array(0.1)}, steps=_IMAGE_STEPS)


# ---- depth and clusters


@maker("valid_depth")
def _() -> DerivativeCase:
    limits = {"nearest": jnp.array(0.3), "farthest": jnp.array(8.0)}
    return _simple(depth_image.valid_depth, {"depth": jnp.array([0.1, 0.31, 3.0, 7.9, 9.0])}, limits)


@maker("sample_depth")
def _() -> DerivativeCase:
    depth = 3.0 + 0.01 * _random(12, 14)
    uv = jnp.array([[3.2, 8.9], [4.4, 7.3]])
    return _simple(depth_image.sample_depth, {"depth": depth}, {"uv": uv})


@maker("lacks_depth")
def _() -> DerivativeCase:
    uv = jnp.array([[3.2, 8.9], [4.4, 7.3]])
    return _simple(depth_image.lacks_depth, {}, {"depth": 3.0 + 0.01 * _random(12, 14), "uv": uv}, bound={"reach": 1})


def _choice_of_depth() -> dict[str, Any]:
    return {"depth": _random(12, 14, low=2, high=3), "intrinsics": camera.make_intrinsics(
        20.0, 20.0, 6.5, 5.5, dtype=jnp.float64
    )}  # fmt: skip


@maker("depth_change")
def _() -> DerivativeCase:
    then = _random(12, 14, low=2, high=3, seed=1)
    constants = _choice_of_depth() | {"depth_then": then, "T_then_now": _pose(0, 0.02), "same_m": jnp.array(0.1)}
    return _simple(depth_change.depth_change, {}, constants)


@maker("classify_visibility")
def _() -> DerivativeCase:
    constants = _choice_of_depth() | {
        "X_world": _points(),
        "T_world_cam": _pose(0, 0.02),
        "least": jnp.full((12, 14), 2.0),
        "same_share": jnp.array(0.02),
        "same_m": jnp.array(0.02),
    }
    return _simple(free_space.classify_visibility, {}, constants)


@maker("dbscan")
def _() -> DerivativeCase:
    bound = {"mask": jnp.ones(8, bool), "min_points": 3}
    return _simple(dbscan.dbscan, {}, {"points": _random(2, 8), "radius": jnp.array(0.5)}, bound=bound)


@maker("nearest_centers")
def _() -> DerivativeCase:
    return _simple(kmeans.nearest_centers, {}, {"points": _random(2, 6), "centers": _random(2, 3, seed=1)})


@maker("kmeans")
def _() -> DerivativeCase:
    initial = jnp.array([[-0.5, 0.5], [-0.5, 0.5]])
    bound = {"key": jax.random.key(0), "mask": jnp.ones(9, bool), "num_clusters": 2, "num_steps": 5}
    return _simple(kmeans.kmeans, {"points": _random(2, 9)}, {"initial": initial}, bound=bound)


@maker("score_points")
def _() -> DerivativeCase:
    shapes = network_shapes(num_features=3, num_group_features=2, num_hidden=4)
    weights = PointNetwork(**{name: _random(*shape, seed=i) for i, (name, shape) in enumerate(shapes.items())})
    carries = {"network": weights, "features": _random(3, 6, seed=20), "group_features": _random(2, 3, seed=21)}
    bound = {"group_of": jnp.array([0, 1, 1, 0, -1, 2]), "mask": jnp.array([True] * 5 + [False])}
    return _simple(score_points, carries, bound=bound, constant_results=("number",))


def _cloud(n: int = 6) -> dict[str, Any]:
    """Points well inside of their voxels."""
    cells = np.array([[0, 0, 1, 1, 2, 0], [0, 0, 0, 0, 1, 2], [1, 1, 0, 0, 0, 0]], float)[:, :n]
    return {"X": jnp.asarray(cells) + 0.5 + 0.2 * _random(3, n), "color": _random(3, n, low=10, high=200)}


@maker("reduced_cloud")
def _() -> DerivativeCase:
    bound = {"mask": jnp.ones(6, bool), "capacity": 8}
    return _simple(voxel_grid.reduced_cloud, _cloud(), {"voxel_m": jnp.array(1.0)}, bound=bound)


def _filled_grid() -> voxel_grid.VoxelGrid:
    cloud = _cloud()
    empty, ones, size = voxel_grid.empty_grid(8, jnp.float64), jnp.ones(6), jnp.array(1.0)
    add = quick_compile(lambda cloud: voxel_grid.with_cloud(empty, **cloud, count=ones, evidence=ones, voxel_m=size)[0])
    return add(cloud)


def _on_grid(kernel: Callable[..., Any], table: Any) -> Callable[..., Any]:
    """The kernel on a grid that is given by its sums."""
    return lambda grid, **values: kernel(voxel_grid.VoxelGrid(table, grid), **values)


@maker("with_cloud")
def _() -> DerivativeCase:
    grid = _filled_grid()
    values = {"grid": grid.sums, **_cloud(), "count": _random(6, low=1, high=3), "evidence": 0.1 * _random(6)}
    return _simple(_on_grid(voxel_grid.with_cloud, grid.table), values | {"voxel_m": jnp.array(1.0)})


@maker("changed")
def _() -> DerivativeCase:
    grid = _filled_grid()
    call = _on_grid(voxel_grid.changed, grid.table)
    values = {"grid": grid.sums, **_cloud(2), "count": _random(2, low=1, high=3), "evidence": 0.1 * _random(2)}
    bound = {"rows": jnp.zeros(2, jnp.int32)}
    return _simple(call, values | {"voxel_m": jnp.array(1.0)}, bound=bound)


@maker("weighed")
def _() -> DerivativeCase:
    grid = _filled_grid()
    values = {"grid": grid.sums, "evidence": 0.1 * _random(2)}
    return _simple(_on_grid(voxel_grid.weighed, grid.table), values, bound={"start": jnp.int32(0)})


@maker("centroids")
def _() -> DerivativeCase:
    grid = _filled_grid()
    values = {"grid": grid.sums, "voxel_m": jnp.array(1.0)}
    return _simple(_on_grid(voxel_grid.centroids, grid.table), values, bound={"start": jnp.int32(0), "size": 3})


@maker("voxel_keys")
def _() -> DerivativeCase:
    return _simple(voxel_hash.voxel_keys, {}, {"X": _points(), "voxel_m": jnp.array(0.1)})


@maker("key_corners")
def _() -> DerivativeCase:
    keys = voxel_hash.voxel_keys(_points(), jnp.array(0.1))[0]
    return _simple(voxel_hash.key_corners, {"voxel_m": jnp.array(0.1)}, bound={"keys": keys})


@maker("find_rows")
def _() -> DerivativeCase:
    keys = voxel_hash.voxel_keys(_points(), jnp.array(0.1))[0]
    bound = {"table": voxel_hash.empty_table(8), "keys": keys, "mask": jnp.ones(N, bool)}
    return _simple(voxel_hash.find_rows, {}, bound=bound)


# ---- trajectories


def _paths(n: int = 8, flat: float = 1.0) -> dict[str, Any]:
    line = jnp.stack([jnp.linspace(0, 3, n), flat * _random(n, seed=1), flat * _random(n, seed=2)])
    moved = transform.to_world(_pose(3), line) + 0.02 * flat * _random(3, n, seed=4)
    return {"estimate_xyz": line, "reference_xyz": moved, "weights": _random(n, low=0.5, high=1.5)}


@maker("align")
def _() -> DerivativeCase:
    near = {"a path that is nearly a line": _paths(7, flat=0.01)}
    return _simple(alignment.align, _paths(), bound={"with_scale": True}, near=near)


@maker("ate")
def _() -> DerivativeCase:
    near = {"a path that is nearly a line": _paths(7, flat=0.01)}
    return _simple(alignment.ate, _paths(), near=near)


def _two_paths(n: int) -> dict[str, Any]:
    estimate = _poses(n)
    errors = 0.05 * np.random.default_rng(5).normal(size=(n, 6))
    moved = quick_compile(jax.vmap(lambda T, e: transform.retract(SE3(T), e).wxyz_xyz))(
        estimate.wxyz_xyz, jnp.asarray(errors)
    )
    return {"estimate": estimate, "reference": SE3(moved)}


@maker("rpe", slow=True)
def _() -> DerivativeCase:
    first, second = jnp.arange(4), jnp.arange(1, 5)
    bound = {"first": first, "second": second, "mask": jnp.ones(4, bool)}
    return _simple(alignment.rpe, _two_paths(5), bound=bound)


@maker("segment_errors", slow=True)
def _() -> DerivativeCase:
    bound = {"mask": jnp.ones(6, bool), "step": 2}
    return _simple(segments.segment_errors, _two_paths(6) | {"lengths": jnp.array([0.3, 0.6])}, bound=bound)
