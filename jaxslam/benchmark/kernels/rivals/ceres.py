"""A window of bundle adjustment as Ceres solves it, with COLMAP's cost functions in C++."""

import numpy as np
import pyceres
import pycolmap

from jaxslam.benchmark.kernels.scenes.bundle_window import CENTER_PX, FOCAL_PX, Window


def ceres_problem(window: Window, num_fixed: int) -> tuple[pycolmap.CeresBundleAdjuster, pycolmap.Reconstruction]:
    """Reprojection of a window from `without_depth`, Cauchy's loss, the first poses fixed.

    Returns:
        The problem, and the model whose memory it works on.
    """
    seen, valid = window.observations, np.asarray(window.observations.valid)
    camera, point = np.asarray(seen.camera)[valid], np.asarray(seen.point)[valid]
    uv = FOCAL_PX * np.asarray(seen.xy, np.float64)[:, valid] + np.array(CENTER_PX)[:, None]
    poses, X_world = (np.asarray(a, np.float64) for a in (window.poses, window.X_world))
    poses = np.concatenate([poses[:, :4] / np.linalg.norm(poses[:, :4], axis=1)[:, None], poses[:, 4:]], axis=1)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[FOCAL_PX, FOCAL_PX, *CENTER_PX], camera_id=1)
    )
    slot = np.zeros(len(camera), int)
    for i, pose in enumerate(poses):
        rows = np.flatnonzero(camera == i)
        slot[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=str(i), keypoints=uv[:, rows].T.copy(), camera_id=1, image_id=i + 1)
        world_from_cam = pycolmap.Rigid3d(pycolmap.Rotation3d(np.roll(pose[:4], -1)), pose[4:])
        model.add_image_with_trivial_frame(image, world_from_cam.inverse())
    seen_points, first = np.unique(np.sort(point), return_index=True)
    rows_of_points = np.split(np.argsort(point, kind="stable"), first[1:])
    for j, rows in zip(seen_points, rows_of_points, strict=True):
        track = pycolmap.Track()
        for row in rows:
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
