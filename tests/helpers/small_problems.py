"""Small problems of every kernel that solves one, in float64: as few points as determine the answer."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.bundle.bundle_adjust import BundleAdjustment, bundle_adjust
from jaxslam_kernels.bundle.cost import Observations, observe
from jaxslam_kernels.camera import make_intrinsics, project
from jaxslam_kernels.pose.pnp import PnpResult, ransac_pnp
from jaxslam_kernels.pose.pose_refine import PoseRefinement, refine_pose
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges
from jaxslam_kernels.pose_graph.pose_graph import PoseGraph, optimize_pose_graph
from jaxslam_kernels.se3 import between, compose, retract, to_camera
from jaxslam_kernels.two_view.fundamental import FundamentalResult, ransac_fundamental
from quick_compile import quick_compile_nested

CAMERA = (200.0, 210.0, 80.0, 60.0)
_between, _compose, _project, _retract, _to_camera = map(
    quick_compile_nested, (between, compose, project, retract, to_camera)
)


class PoseInputs(NamedTuple):
    """A pose seen by points in front of it, with noise in the pixels."""

    T_world_cam: SE3
    X_world: jax.Array
    uv: jax.Array


def identity() -> SE3:
    return SE3(jnp.array([1.0, 0, 0, 0, 0, 0, 0]))


def pose_inputs(n: int = 12, seed: int = 0) -> PoseInputs:
    rng = np.random.default_rng(seed)
    T = _retract(identity(), jnp.array([0.1, 0.2, -0.1, 0.1, -0.2, 0.05]))
    X_world = jnp.asarray(rng.uniform([-1, -1, 2], [1, 1, 5], (n, 3)).T)
    uv = _project(make_intrinsics(*CAMERA, dtype=jnp.float64), _to_camera(T, X_world))
    return PoseInputs(_retract(T, jnp.full(6, 0.01)), X_world, uv + jnp.asarray(rng.normal(size=(2, n))) * 0.5)


def refine(inputs: PoseInputs, weights: jax.Array) -> PoseRefinement:
    camera = make_intrinsics(*CAMERA, dtype=jnp.float64)
    return refine_pose(*inputs, camera, weights=weights, max_steps=100)


def ransac(inputs: PoseInputs, weights: jax.Array) -> PnpResult:
    camera = make_intrinsics(*CAMERA, dtype=jnp.float64)
    return ransac_pnp(
        jax.random.key(0),
        *inputs[1:],
        camera,
        weights=weights,
        initial=inputs.T_world_cam,
        num_hypotheses=4,
        min_inliers=4,
        max_steps=100,
    )


class BundleInputs(NamedTuple):
    """Three cameras side by side, two of them fixed, that see all points."""

    poses: jax.Array
    X_world: jax.Array
    observations: Observations


def bundle_inputs(n: int = 8, seed: int = 1) -> BundleInputs:
    rng = np.random.default_rng(seed)
    camera = make_intrinsics(*CAMERA, dtype=jnp.float64)
    X_world = jnp.asarray(rng.uniform([-1, -1, 3], [1, 1, 5], (n, 3)).T)
    tangents = rng.normal(size=(3, 6)) * 0.02 + np.arange(3)[:, None] * np.array([0.5, 0, 0, 0, 0, 0])
    poses = [_retract(identity(), jnp.asarray(t)) for t in tangents]
    uv = jnp.concatenate([_project(camera, _to_camera(T, X_world)) for T in poses], axis=1)
    uv = uv + jnp.asarray(rng.normal(size=uv.shape)) * 0.5
    index = jnp.asarray(np.stack(np.meshgrid(np.arange(3), np.arange(n), indexing="ij")).reshape(2, -1), jnp.int32)
    start = jnp.stack([T.wxyz_xyz for T in (*poses[:2], _retract(poses[2], jnp.full(6, 0.01)))])
    return BundleInputs(
        start, X_world + jnp.asarray(rng.normal(size=(3, n))) * 0.05, observe(index[0], index[1], uv, camera)
    )


def adjust(
    inputs: BundleInputs, point_weights: jax.Array | None = None, weights: jax.Array | None = None
) -> BundleAdjustment:
    observations = inputs.observations if weights is None else inputs.observations._replace(weights=weights)
    return bundle_adjust(
        *inputs[:2],
        observations,
        fixed_poses=jnp.array([True, True, False]),
        point_weights=point_weights,
        tolerance=0.0,
        max_steps=60,
    )


def graph_inputs(seed: int = 2) -> tuple[SE3, PoseGraphEdges]:
    """Four nodes, of which the last has no edge, and six edges among the others, with noise in all."""
    rng = np.random.default_rng(seed)
    nodes = [_retract(identity(), jnp.asarray(t)) for t in rng.normal(size=(4, 6)) * 0.5]
    source, target = np.array([0, 0, 1, 1, 2, 0]), np.array([1, 2, 2, 0, 0, 2])
    measured = [
        _retract(_between(nodes[s], nodes[t]), jnp.asarray(rng.normal(size=6) * 0.05))
        for s, t in zip(source, target, strict=True)
    ]
    edges = PoseGraphEdges(
        source=jnp.asarray(source),
        target=jnp.asarray(target),
        T_source_target=SE3(jnp.stack([T.wxyz_xyz for T in measured])),
        information=jnp.broadcast_to(jnp.diag(jnp.array([4.0, 4, 4, 9, 9, 9])), (6, 6, 6)),
        weights=jnp.ones(6),
        mask=jnp.ones(6, bool),
    )
    start = SE3(jnp.stack([_retract(T, jnp.full(6, 0.02)).wxyz_xyz for T in nodes]))
    return start, edges


def optimize(inputs: tuple[SE3, PoseGraphEdges], weights: jax.Array) -> PoseGraph:
    start, edges = inputs
    fixed = jnp.array([True, False, False, False])
    return optimize_pose_graph(start, edges._replace(weights=weights), fixed, loss="cauchy", group_size=16)


def match_inputs(n: int = 20, seed: int = 3) -> tuple[jax.Array, jax.Array]:
    """Pixels of points in two views, with noise."""
    rng = np.random.default_rng(seed)
    camera = make_intrinsics(*CAMERA, dtype=jnp.float64)
    X_world = jnp.asarray(rng.uniform([-1, -1, 2], [1, 1, 5], (n, 3)).T)
    second = _compose(identity(), _retract(identity(), jnp.array([0.4, 0.1, 0.05, 0.02, -0.05, 0.03])))
    before, after = (_project(camera, _to_camera(T, X_world)) for T in (identity(), second))
    noise = jnp.asarray(rng.normal(size=(2, 2, n))) * 0.2
    return before + noise[0], after + noise[1]


def match(inputs: tuple[jax.Array, jax.Array], weights: jax.Array) -> FundamentalResult:
    return ransac_fundamental(
        jax.random.key(0), *inputs, weights=weights, num_hypotheses=16, num_improved=0, threshold_px=3.0, max_steps=100
    )
