"""Every public kernel with arguments that fit it, as shapes."""

from collections.abc import Callable
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
from jaxslam_kernels.image import corners
from jaxslam_kernels.image import pyramid as image
from jaxslam_kernels.point_network import PointNetwork, network_shapes, score_points
from jaxslam_kernels.pose import absolute_orientation, p3p, pnp, pose_refine
from jaxslam_kernels.pose.pose_cost import PosePrior, PoseProblem
from jaxslam_kernels.pose_graph import cost as pose_graph_cost
from jaxslam_kernels.pose_graph import pose_graph
from jaxslam_kernels.ransac_sampling import draw_samples
from jaxslam_kernels.trajectory import alignment
from jaxslam_kernels.trajectory import kitti_drift as segments
from jaxslam_kernels.two_view import epipolar, fundamental


class Case(NamedTuple):
    """A kernel and what it is called with.

    Attributes:
        function: The kernel, its static options bound.
        arguments: By name, with shapes for arrays.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]


def f(*shape: int) -> Any:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def i(*shape: int) -> Any:
    return jax.ShapeDtypeStruct(shape, jnp.int32)


def b(*shape: int) -> Any:
    return jax.ShapeDtypeStruct(shape, jnp.bool_)


def transforms(*batch: int) -> SE3:
    return jax.eval_shape(SE3, f(*batch, 7))


CAMERA = camera.Intrinsics(f(), f(), f(), f(), f(5))
KEY = jax.eval_shape(lambda: jax.random.key(0))


def _pyramid() -> image.Pyramid:
    return jax.eval_shape(partial(image.build_pyramid, num_levels=1), f(40, 48))


def cases(n: int = 11) -> dict[str, Case]:
    """By name of the kernel, for `n` points, edges, pairs, poses or voxels."""
    Observations, Edges = bundle_cost.Observations, pose_graph_cost.PoseGraphEdges
    observations = Observations(i(n), i(n), f(2, n), f(n), f(3, n), f(n), b(n))
    edges = Edges(i(n), i(n), transforms(n), f(n, 6, 6), f(n), b(n))
    problem = PoseProblem(f(3, n), f(2, n), f(n), f(3, n), f(n), f(), None)
    pyramid, table = _pyramid(), jax.eval_shape(partial(voxel_hash.empty_table, 8))
    grid = voxel_grid.VoxelGrid(table, f(8, 8))
    bound: dict[Any, dict[str, Any]] = {
        absolute_orientation.absolute_orientation: {"source": f(3, 3, n), "target": f(3, 3, n)},
        partial(alignment.align, with_scale=True): {"estimate_xyz": f(3, n), "reference_xyz": f(3, n), "weights": f(n)},
        alignment.ate: {"estimate_xyz": f(3, n), "reference_xyz": f(3, n), "weights": f(n)},
        alignment.rpe: {
            "estimate": transforms(n),
            "reference": transforms(n),
            "first": i(n),
            "second": i(n),
            "mask": b(n),
        },
        alignment.usable_poses: {"T": transforms(n)},
        bundle_adjust.bundle_adjust: {
            "poses": f(3, 7),
            "X_world": f(3, n),
            "observations": observations,
            "fixed_poses": b(3),
            "fixed_points": b(n),
            "point_weights": f(n),
            "edges": edges,
            "scale": f(),
            "tolerance": f(),
        },
        bundle_cost.observe: {
            "camera": i(n),
            "point": i(n),
            "uv": f(2, n),
            "intrinsics": CAMERA,
            "depth": f(n),
            "sigma_px": f(n),
            "sigma_depth": f(),
            "weights": f(n),
            "valid": b(n),
        },
        camera.without_distortion: {"intrinsics": CAMERA},
        camera.in_front: {"X_cam": f(3, n)},
        camera.project: {"intrinsics": CAMERA, "X_cam": f(3, n)},
        camera.back_project: {"intrinsics": CAMERA, "uv": f(2, n), "depth": f(n)},
        camera.to_pixels: {"intrinsics": CAMERA, "xy": f(2, n)},
        camera.distort: {"intrinsics": CAMERA, "xy": f(2, n)},
        camera.normalize: {"intrinsics": CAMERA, "uv": f(2, n)},
        camera.undistort_pixels: {"intrinsics": CAMERA, "uv": f(2, n)},
        camera.depth_from_disparity: {"disparity": f(n), "fx": f(), "baseline": f()},
        camera.disparity_from_depth: {"depth": f(n), "fx": f(), "baseline": f()},
        corners.corner_score: {"image": f(n, n)},
        partial(corners.grid_corners, cell=4): {"score": f(n, n), "allowed": b(n, n)},
        partial(corners.occupied_cells, shape=(40, 48), cell=8): {"points": f(2, n), "valid": b(n)},
        partial(dbscan.dbscan, min_points=3): {"points": f(2, n), "mask": b(n), "radius": f()},
        depth_change.depth_change: {
            "depth": f(40, 48),
            "depth_then": f(40, 48),
            "T_then_now": transforms(),
            "intrinsics": CAMERA,
            "same_m": f(),
        },
        depth_image.valid_depth: {"depth": f(n), "nearest": f(), "farthest": f()},
        depth_image.sample_depth: {"depth": f(40, 48), "uv": f(2, n)},
        partial(depth_image.lacks_depth, reach=2): {"depth": f(40, 48), "uv": f(2, n)},
        disparity.row_disparities: {
            "left": pyramid,
            "right": pyramid,
            "points": f(2, n),
            "guess": f(n),
            "mask": b(n),
            "least": f(),
        },
        epipolar.epipolar_distances: {"F": f(3, 3), "uv_before": f(2, n), "uv_after": f(2, n)},
        epipolar.sampson_distances: {"F": f(3, 3), "uv_before": f(2, n), "uv_after": f(2, n)},
        epipolar.sampson_squared: {"F": f(3, 3, 2), "before": f(2, n), "after": f(2, n)},
        epipolar.fundamental_of_poses: {
            "T_world_before": transforms(),
            "T_world_after": transforms(),
            "intrinsics": CAMERA,
        },
        epipolar.seven_point: {"uv_before": f(2, 7, n), "uv_after": f(2, 7, n)},
        epipolar.adjugate: {"F": f(3, 3, n)},
        free_space.classify_visibility: {
            "X_world": f(3, n),
            "T_world_cam": transforms(),
            "depth": f(40, 48),
            "least": f(40, 48),
            "intrinsics": CAMERA,
            "same_share": f(),
            "same_m": f(),
        },
        partial(fundamental.ransac_fundamental, num_hypotheses=4, num_improved=1): {
            "key": KEY,
            "uv_before": f(2, n),
            "uv_after": f(2, n),
            "weights": f(n),
            "threshold_px": f(),
        },
        image.half_size: {"image": f(40, 48)},
        image.build_pyramid: {"image": f(40, 48)},
        kmeans.nearest_centers: {"points": f(2, n), "centers": f(2, 3)},
        score_points: {
            "network": PointNetwork(**{name: f(*shape) for name, shape in network_shapes(5, 2, 3).items()}),
            "features": f(5, n),
            "group_features": f(2, 4),
            "group_of": i(n),
            "mask": b(n),
        },
        partial(kmeans.kmeans, num_clusters=2, num_steps=2): {
            "key": KEY,
            "points": f(2, n),
            "mask": b(n),
            "initial": f(2, 2),
            "usable": b(2),
        },
        lk_flow.lk_flow: {"previous": pyramid, "current": pyramid, "points": f(2, n), "guess": f(2, n), "mask": b(n)},
        lk_flow.lk_flow_forward_backward: {
            "previous": pyramid,
            "current": pyramid,
            "points": f(2, n),
            "expected_px": f(),
        },
        motion.scene_flow: {"X_world": f(3, n), "X_cam": f(3, n), "T_world_cam": transforms()},
        motion.flow_length: {"flow": f(3, n)},
        motion.upper_limit: {"intensity": f(n), "weights": f(n), "sigmas": f()},
        partial(motion.group_motion, num_groups=2): {"flow": f(3, n), "moves": f(n), "counts": b(n), "group": i(n)},
        p3p.p3p: {"bearings": f(3, 3, n), "X_world": f(3, 3, n)},
        p3p.p3p_near: {"bearings": f(3, 3, n), "X_world": f(3, 3, n), "distances": f(3, n)},
        partial(patch_align.warped_patches, side=5, stride=8): {
            "pictures": f(2, 40, 48),
            "picture": i(n),
            "center": f(2, n),
            "warp": f(2, 2, n),
        },
        patch_align.align_patches: {
            "pictures": f(2, 40, 48),
            "picture": i(n),
            "center": f(2, n),
            "warp": f(2, 2, n),
            "current": pyramid,
            "guess": f(2, n),
            "mask": b(n),
            "min_texture": f(),
        },
        partial(pnp.ransac_pnp, num_hypotheses=4): {
            "key": KEY,
            "X_world": f(3, n),
            "uv": f(2, n),
            "intrinsics": CAMERA,
            "weights": f(n),
            "depth": f(n),
            "initial": transforms(),
            "threshold_px": f(),
            "prior": PosePrior(transforms(), f(6, 6)),
        },
        partial(draw_samples, num_samples=3, size=4): {"key": KEY, "weights": f(n)},
        pnp.score_poses: {"T_cam_world": f(3, 4, 2), "problem": problem},
        partial(pose_graph.optimize_pose_graph, group_size=16): {
            "T_world_cam": transforms(n),
            "edges": edges,
            "fixed": b(n),
            "loss_scale": f(),
        },
        pose_refine.refine_pose: {
            "T_world_cam": transforms(),
            "X_world": f(3, n),
            "uv": f(2, n),
            "intrinsics": CAMERA,
            "weights": f(n),
            "depth": f(n),
            "sigma_px": f(n),
            "scale": f(),
            "prior": PosePrior(transforms(), f(6, 6)),
        },
        pose_refine.usable_pose: {"T": transforms()},
        partial(robust.loss_value, loss="huber"): {"squared": f(n), "scale": f()},
        partial(robust.loss_weight, loss="huber"): {"squared": f(n), "scale": f()},
        robust.weighted_median: {"values": f(n), "weights": f(n)},
        robust.masked_median: {"values": f(n), "mask": b(n)},
        robust.robust_scale: {"residuals": f(n), "weights": f(n)},
        rolling_shutter.image_velocity: {"xy": f(2, n), "depth": f(n), "twist": f(6)},
        partial(rolling_shutter.row_time, height=40): {"v": f(n), "readout_s": f()},
        partial(rolling_shutter.as_if_at_once, height=40): {
            "xy": f(2, n),
            "velocity": f(2, n),
            "v": f(n),
            "readout_s": f(),
        },
        segments.segment_errors: {"estimate": transforms(n), "reference": transforms(n), "mask": b(n), "lengths": f(2)},
        transform.retract: {"T_a_b": transforms(), "tangent_b": f(6)},
        transform.compose: {"T_a_b": transforms(n), "T_b_c": transforms(n)},
        transform.between: {"T_world_a": transforms(n), "T_world_b": transforms(n)},
        transform.displacement: {"T_world_a": transforms(), "T_world_b": transforms()},
        transform.rotation_matrix: {"T_a_b": transforms()},
        transform.to_camera: {"T_world_cam": transforms(), "X_world": f(3, n)},
        transform.to_world: {"T_world_cam": transforms(), "X_cam": f(3, n)},
        transform.cross_matrix: {"v": f(3)},
        partial(voxel_grid.reduced_cloud, capacity=8): {
            "X": f(3, n),
            "color": f(3, n),
            "mask": b(n),
            "voxel_m": f(),
        },
        voxel_grid.with_cloud: {
            "grid": grid,
            "X": f(3, n),
            "color": f(3, n),
            "count": f(n),
            "evidence": f(n),
            "voxel_m": f(),
        },
        voxel_grid.changed: {
            "grid": grid,
            "rows": i(n),
            "X": f(3, n),
            "color": f(3, n),
            "count": f(n),
            "evidence": f(n),
            "voxel_m": f(),
        },
        voxel_grid.weighed: {"grid": grid, "start": i(), "evidence": f(min(n, 8))},
        partial(voxel_grid.centroids, size=4): {"grid": grid, "start": i(), "voxel_m": f()},
        voxel_hash.voxel_keys: {"X": f(3, n), "voxel_m": f()},
        voxel_hash.key_corners: {"keys": jax.ShapeDtypeStruct((2, n), jnp.uint32), "voxel_m": f()},
        voxel_hash.find_rows: {
            "table": table,
            "keys": jax.ShapeDtypeStruct((2, n), jnp.uint32),
            "mask": b(n),
        },
    }
    name = lambda function: (function.func if isinstance(function, partial) else function).__name__
    return {name(function): Case(function, arguments) for function, arguments in bound.items()}


def filled(tree: Any) -> Any:
    """Arrays for shapes: ones, the first few indices, everything true."""

    def fill(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.key(0)
        if leaf.dtype == jnp.int32 and leaf.shape:
            return jnp.asarray(np.zeros(leaf.shape), leaf.dtype)
        return jnp.ones(leaf.shape, leaf.dtype)

    return jax.tree.map(fill, tree)
