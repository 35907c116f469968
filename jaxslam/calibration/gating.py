"""Accept the parameters with which frames that were not fitted to are explained better."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.calibration.batch_solve import BatchProblem, BatchSolution, BlockState, solve_batch
from jaxslam.calibration.parameters import CameraVector, group_mask

_CONTINUED_STEPS = 6
"""Steps of a solve that begins near its optimum."""
_SURE = 1.64
"""Signed-rank statistic above which a group stays: chance is above it in 5 % of cases only."""

Step = Callable[[str], None]
"""Told what is done next."""


class HeldOut(NamedTuple):
    """Costs of frames that were not fitted to.

    Attributes:
        costs: `(b,)` cost of each block, with the camera fitted to the other half of the blocks.
        cameras: Camera fitted to each half.
    """

    costs: Float[np.ndarray, " b"]
    cameras: tuple[CameraVector, CameraVector]


@dataclass(frozen=True, eq=False)
class Gate:
    """Accepted groups of parameters, and the costs of held-out frames.

    Attributes:
        accepted: Groups of parameters that may change.
        gains: By how much the cost of held-out frames grows, as a share, if a group stays as it was and the others
            follow; by group.
        before: Costs of held-out frames with the camera as it was.
        after: The same with the accepted groups fitted to other frames.
    """

    accepted: tuple[str, ...]
    gains: dict[str, float]
    before: HeldOut
    after: HeldOut


def gate(
    problem: BatchProblem,
    start: CameraVector,
    fitted: BatchSolution,
    groups: Sequence[str],
    on_step: Step = lambda _: None,
) -> Gate:
    """Decide which groups of parameters may change.

    Every other block is fitted to, and the rest is held out; then the other way round. On held-out blocks the camera is
    fixed, and poses and points are found anew. Each group is left out in turn, and leaves for good if held-out frames
    are not surely worse for it (5 %, signed ranks); the other groups are fitted again each time.

    Args:
        problem: The problem, with the noise as estimated.
        start: Camera as it was.
        fitted: Solution of the whole problem with all groups free, from which solves begin.
        groups: Groups to decide on, the one that probably changes least first: it is asked about while all others are
            free.
        on_step: Told what is done next.
    """
    on_step("held-out frames, camera as it was")
    before = _held_out(problem, start, fitted, ())
    accepted, gains = tuple(groups), {}
    on_step("held-out frames, all parameters")
    after = _held_out(problem, start, fitted, accepted)
    for group in groups:
        on_step(f"held-out frames without {group}")
        rest = tuple(each for each in accepted if each != group)
        without = _held_out(problem, start, fitted, rest)
        gains[group] = float(without.costs.sum() / after.costs.sum() - 1)
        if _signed_rank(after.costs, without.costs) <= _SURE:
            accepted, after = rest, without
    return Gate(accepted, gains, before, after)


def _held_out(problem: BatchProblem, start: CameraVector, fitted: BatchSolution, groups: tuple[str, ...]) -> HeldOut:
    free = group_mask(groups)
    costs, cameras = np.zeros(len(problem.blocks)), []
    for half in (0, 1):
        used, held = _part(problem, fitted.states, half), _part(problem, fitted.states, 1 - half)
        first = np.where(free, fitted.camera, start)
        camera = first if not groups else solve_batch(*_with(used, first), free, max_steps=_CONTINUED_STEPS).camera
        nothing = np.zeros(len(free), bool)
        costs[1 - half :: 2] = solve_batch(*_with(held, camera), nothing, max_steps=_CONTINUED_STEPS).costs
        cameras.append(camera)
    return HeldOut(costs, (cameras[0], cameras[1]))


def _part(problem: BatchProblem, states: Sequence[BlockState], half: int) -> tuple[BatchProblem, Sequence[BlockState]]:
    return replace(problem, blocks=problem.blocks[half::2]), states[half::2]


def _with(
    part: tuple[BatchProblem, Sequence[BlockState]], camera: CameraVector
) -> tuple[BatchProblem, CameraVector, Sequence[BlockState]]:
    return part[0], camera, part[1]


def _signed_rank(costs: Float[np.ndarray, " b"], others: Float[np.ndarray, " b"]) -> float:
    """Return how surely blocks cost less than with another camera: a standard normal number if only chance decides.

    By ranks, since blocks in which the camera moves fast gain many times what others do.

    Source: Wilcoxon, "Individual Comparisons by Ranking Methods", 1945.
    """
    gained = others - costs
    ranks = 1.0 + np.argsort(np.argsort(np.abs(gained)))
    n = len(gained)
    return float((ranks[gained > 0].sum() - n * (n + 1) / 4) / np.sqrt(n * (n + 1) * (2 * n + 1) / 24))
