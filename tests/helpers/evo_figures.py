"""The figures of evo on matched poses. evo is GPL: in tests only."""

import numpy as np
from evo.core import lie_algebra, metrics, trajectory

from jaxslam.trajectory.evaluation import AlignmentKind
from jaxslam.trajectory.trajectory import Trajectory


class Evo:
    """evo on an estimate and the true poses at the same times.

    Attributes:
        estimate: Aligned.
        reference: The truth.
        scale: What the estimate was scaled by.
    """

    def __init__(self, estimate: Trajectory, reference: Trajectory, align: AlignmentKind) -> None:
        self.estimate, self.reference = (
            trajectory.PosePath3D(t.positions.copy(), t.T_world_cam[:, :4].copy()) for t in (estimate, reference)
        )
        self.scale = 1.0
        if align != "none":
            *_, self.scale = self.estimate.align(self.reference, correct_scale=align == "sim3")

    def ate(self) -> dict[str, float]:
        """Figures of the absolute error by their names: rmse, mean, median, max, std, ..."""
        metric = metrics.APE(metrics.PoseRelation.translation_part)
        metric.process_data((self.reference, self.estimate))
        return metric.get_all_statistics()

    def rpe(self, relation: str, delta: int = 1, *, all_pairs: bool = False, statistic: str = "rmse") -> float:
        """Errors over pairs so many frames apart, in meters (`translation_part`) or degrees (`rotation_angle_deg`)."""
        metric = metrics.RPE(getattr(metrics.PoseRelation, relation), delta, metrics.Unit.frames, all_pairs=all_pairs)
        metric.process_data((self.reference, self.estimate))
        return metric.get_statistic(metrics.StatisticsType(statistic))

    def rpe_of(self, first: np.ndarray, second: np.ndarray, seconds: np.ndarray) -> tuple[float, float]:
        """RMSE in meters and in degrees a second over given pairs, so many seconds apart.

        evo chooses pairs by frames, meters or angles, never by seconds, and divides by nothing.
        """
        Q, P = self.reference.poses_se3, self.estimate.poses_se3
        E = [metrics.RPE.rpe_base(Q[i], Q[j], P[i], P[j]) for i, j in zip(first, second, strict=True)]
        metric = metrics.RPE()
        metric.error = np.array([np.linalg.norm(E_ij[:3, 3]) for E_ij in E]) / seconds
        meters = metric.get_statistic(metrics.StatisticsType.rmse)
        metric.error = np.array([lie_algebra.so3_log_angle(E_ij[:3, :3], degrees=True) for E_ij in E]) / seconds
        return meters, metric.get_statistic(metrics.StatisticsType.rmse)
