"""A window of bundle adjustment as Ceres solves it, with COLMAP's cost functions in C++."""

import numpy as np
import pyceres
import pycolmap


def ceres_problem(
    poses: np.ndarray, X_world: np.ndarray, camera: np.ndarray, point: np.ndarray, uv: np.ndarray, num_fixed: int
) -> tuple[pycolmap.CeresBundleAdjuster, pycolmap.Reconstruction]:
    """Reprojection of ideal cameras (focal length 500, centre 320, 240), Cauchy's loss, the first poses fixed.

    Args:
        poses: `(k, 7)` `wxyz_xyz` of T_world_cam.
        X_world: `(3, n)`.
        camera: `(m,)` index of the pose.
        point: `(m,)` index of the point, each seen at least twice.
        uv: `(2, m)` pixels.
        num_fixed: Poses that do not move.

    Returns:
        The problem, and the model whose memory it works on.
    """
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500.0, 500.0, 320.0, 240.0], camera_id=1)
    )
    slot = np.zeros(len(camera), int)
    for i, pose in enumerate(poses):
        rows = np.flatnonzero(camera == i)
        slot[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=str(i), keypoints=uv[:, rows].T.copy(), camera_id=1, image_id=i + 1)
        world_from_cam = pycolmap.Rigid3d(pycolmap.Rotation3d(np.roll(pose[:4], -1)), pose[4:])
        model.add_image_with_trivial_frame(image, world_from_cam.inverse())
    for j in np.unique(point):
        track = pycolmap.Track()
        for row in np.flatnonzero(point == j):
            track.add_element(int(camera[row]) + 1, int(slot[row]))
        model.add_point3D(X_world[:, j], track)
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(poses)):
        config.add_image(i + 1)
        if i < num_fixed:
            config.set_constant_rig_from_world_pose(i + 1)
    config.set_constant_cam_intrinsics(1)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 2.0
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model), model


def solve(adjuster: pycolmap.CeresBundleAdjuster, steps: int) -> pyceres.SolverSummary:
    """So many steps on one thread, dense Schur complement as Ceres advises for few cameras."""
    settings = pyceres.SolverOptions()
    settings.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    settings.max_num_iterations = steps
    settings.num_threads = 1
    settings.function_tolerance = settings.gradient_tolerance = settings.parameter_tolerance = 0.0
    settings.logging_type = pyceres.LoggingType.SILENT
    summary = pyceres.SolverSummary()
    pyceres.solve(settings, adjuster.problem, summary)
    return summary
