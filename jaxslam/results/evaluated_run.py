"""The evaluation of a run: the same for runs of ours and for those of other systems."""

from dataclasses import replace
from typing import Any, NamedTuple

from jaxslam.datasets import Dataset
from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.evaluation import Evaluation, evaluate
from jaxslam.trajectory.trajectory import Trajectory

_SHOWN_FIRST = ("ate_rmse_m", "ate_sim3_rmse_m", "sim3_scale", "rpe_trans_m_per_s", "rpe_rot_deg_per_s")


class EvaluatedRun(NamedTuple):
    """The trajectory of a run compared with the ground truth of its recording.

    Attributes:
        evaluation: Errors of the trajectory; `None` if it cannot be compared.
        problem: Why it cannot be compared; `None` if it can.
    """

    evaluation: Evaluation | None
    problem: str | None

    @property
    def figures(self) -> dict[str, Any]:
        """Figures for a summary: the best-known ones by name, all as `evaluation`, and `evaluation_problem`."""
        every = {} if self.evaluation is None else self.evaluation.summary()
        first = {name: every.get(name) for name in _SHOWN_FIRST}
        return {**first, "evaluation": every or None, "evaluation_problem": self.problem}


def evaluate_run(trajectory: Trajectory, dataset: Dataset, notes: tuple[str, ...] = ()) -> EvaluatedRun:
    """Compare the trajectory of a run with the ground truth of its recording, after SE(3) alignment.

    Args:
        trajectory: Estimated poses.
        dataset: Recording that was tracked, or a part of one; the coverage is that of its frames.
        notes: What is known about the trajectory, put before the notes of the evaluation.
    """
    if dataset.ground_truth is None:
        return EvaluatedRun(None, "no ground truth")
    try:
        evaluation = evaluate(trajectory, dataset.ground_truth, frames_ns=dataset.timestamps_ns)
    except TrajectoryError as problem:
        return EvaluatedRun(None, str(problem))
    return EvaluatedRun(replace(evaluation, notes=notes + evaluation.notes), None)
