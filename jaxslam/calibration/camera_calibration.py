"""Calibrate a camera from an ordinary recording: track it, fit camera, poses and points together, track it again."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from jaxslam.calibration.batch_solve import (
    BatchProblem,
    BatchSolution,
    estimated_noise,
    first_states,
    residuals_of_states,
    solve_batch,
    with_depth_looked_up,
)
from jaxslam.calibration.elimination import Noise
from jaxslam.calibration.gating import Gate, gate
from jaxslam.calibration.gyro_calibration import calibrate_gyro
from jaxslam.calibration.parameters import (
    EXTRINSICS,
    GROUPS,
    PARAMETERS,
    READOUT,
    CameraVector,
    camera_of,
    group_mask,
    index_of,
    prior_sigmas,
    vector_of,
)
from jaxslam.calibration.report import Calibration, Estimate, ResidualField, Verdict
from jaxslam.calibration.scale import Scale, scale_of
from jaxslam.calibration.track_alignment import aligned
from jaxslam.calibration.track_block import TrackBlock
from jaxslam.calibration.track_recorder import TrackRecorder
from jaxslam.calibration.uncertainty import standard_deviations
from jaxslam.config.schema import Config
from jaxslam.datasets import Dataset, imu_samples, imu_sheet
from jaxslam.errors import CameraError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.camera_difference import distance_of_projections_px
from jaxslam.sensors.frame import Frame, to_gray
from jaxslam.slam.slam import Slam
from jaxslam.trajectory.trajectory import Trajectory

OnProgress: TypeAlias = Callable[[str, int, int], None]
"""Told what is being done, how many steps of it are done, and of how many; 0 if that is not known."""

_ROUNDS = 3
_SETTLED_PX = 0.1
"""Mean change of projections below which the recording is not tracked again."""
_FIRST_NOISE = Noise(0.5, 1.0, 1.0)
_NOISE_ROUNDS, _ALIGNED_BEFORE = 5, (1, 3)
"""Fits after the first one, and those of them before which points are looked up again in the images."""
_TOLD = 0.5
"""Largest standard deviation of a parameter that a recording tells, in those assumed beforehand."""
_SURE_OF_SCALE = 2.0
"""Standard deviations by which a scale must differ from 1."""
_LIMITS = {"depth_offset_m": (-1.0, 1.0), "depth_delay_s": (-0.5, 0.5), "readout_s": (0.0, 0.1)}
"""Smallest and largest values that a camera file may hold."""


@dataclass(frozen=True, eq=False)
class _Tracked:
    """A recording as tracked once."""

    problem: BatchProblem
    fitted: BatchSolution
    trajectory: Trajectory


class WithCamera:
    """A recording with another camera than it came with, and without an IMU, which is to be calibrated itself.

    Attributes:
        camera: The other camera.
        name: Name of the recording.
        timestamps_ns: `(n,)` int64 times of the frames, nanoseconds.
        ground_truth: True poses; `None` if unknown.
    """

    def __init__(self, dataset: Dataset, camera: Camera) -> None:
        """Take a recording.

        Args:
            dataset: The recording.
            camera: The other camera; it only says how images are understood, not how they are read.
        """
        self._dataset, self.camera, self.name = dataset, camera, dataset.name
        self.timestamps_ns, self.ground_truth = dataset.timestamps_ns, dataset.ground_truth

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        return self._dataset[index]


def calibrate(
    dataset: Dataset,
    config: Config | None = None,
    *,
    rounds: int = _ROUNDS,
    scale: float | Trajectory | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> Calibration:
    """Calibrate the camera of a recording, beginning with the camera that it comes with.

    Args:
        dataset: The recording, with depth of a sensor. Its `camera` is the start.
        config: Settings of the tracker; those of the default preset if not given.
        rounds: Number of times that the recording is tracked at most, each time with the camera found before.
        scale: Distance between the first and the last place of the camera, meters, or its true path: without it the
            scale of depth cannot be told.
        on_progress: Told what is being done.

    Raises:
        DatasetError: If too little of the recording is tracked, or `scale` does not tell the scale.
        CameraError: If the recording is of stereo pairs.
    """
    if dataset.camera.is_stereo:
        raise CameraError(
            f"camera '{dataset.camera.name}': expected a camera with depth images, got a stereo pair, whose depth is"
            " computed from the very focal length and baseline in question; calibrate a pair with a target"
        )
    start = dataset.camera
    camera, done = start, 0
    while True:
        tracked = _track_and_fit(WithCamera(dataset, camera), config or Config(), start, done + 1, on_progress)
        found = _possible(tracked.fitted.camera, start)
        done += 1
        settled = done > 1 and distance_of_projections_px(camera, found) < _SETTLED_PX
        if done >= rounds or settled:
            found_scale = None if scale is None else scale_of(tracked.trajectory, scale)
            gyro = _gyro_estimates(dataset, tracked.trajectory)
            calibration = _gated(tracked, start, done, found_scale, on_progress)
            return replace(calibration, estimates=(*calibration.estimates, *gyro))
        camera = found


def _gyro_estimates(dataset: Dataset, trajectory: Trajectory) -> tuple[Estimate, ...]:
    samples, sheet = imu_samples(dataset), imu_sheet(dataset)
    return () if samples is None or sheet is None else calibrate_gyro(trajectory, samples, sheet)


def _track_and_fit(
    dataset: WithCamera, config: Config, start: Camera, number: int, on_progress: OnProgress
) -> _Tracked:
    stage = f"tracking, round {number}"
    recorder = TrackRecorder(dataset.camera, config.track)
    with Slam(dataset.camera, config) as slam:

        def on_frame(frame, result) -> None:
            recorder(frame, result)
            on_progress(stage, recorder.num_frames, len(dataset))

        slam.run(dataset, on_frame)
        trajectory = slam.trajectory
    free = group_mask(GROUPS)
    problem = BatchProblem(
        recorder.blocks(),
        vector_of(start),
        prior_sigmas(start),
        start.height,
        _FIRST_NOISE,
        recorder.depth,
    )
    solution = solve_batch(problem, vector_of(dataset.camera), first_states(problem.blocks), free)
    for index in range(_NOISE_ROUNDS):
        on_progress(f"fitting, round {number}", index + 1, _NOISE_ROUNDS + 1)
        if index in _ALIGNED_BEFORE:
            problem = _with_tracks_aligned(problem, solution, dataset)
        problem = with_depth_looked_up(problem, solution)
        problem = replace(problem, noise=estimated_noise(problem, solution))
        solution = solve_batch(problem, solution.camera, solution.states, free)
    return _Tracked(problem, solution, trajectory)


def _with_tracks_aligned(problem: BatchProblem, solution: BatchSolution, dataset: Dataset) -> BatchProblem:
    """Return the problem with all points looked up again in the images, block by block; see `aligned`."""
    blocks = []
    for block, state in zip(problem.blocks, solution.states, strict=True):
        index = np.searchsorted(dataset.timestamps_ns, block.timestamps_ns)
        images = np.stack([to_gray(dataset[int(each)].image) for each in index])
        blocks.append(aligned(block, state, solution.camera, images))
    return replace(problem, blocks=blocks)


def _gated(tracked: _Tracked, start: Camera, rounds: int, scale: Scale | None, on_progress: OnProgress) -> Calibration:
    """Decide what may change, and fit that to the whole recording."""
    problem, fitted = tracked.problem, tracked.fitted
    before, groups = vector_of(start), GROUPS
    free = group_mask(groups)
    all_sigmas = standard_deviations(problem, fitted, free)
    told = tuple(group for group in groups if _is_told(group, all_sigmas, problem.prior_sigma))
    change = np.square((fitted.camera - before) / all_sigmas)
    told = tuple(sorted(told, key=lambda group: float(change[group_mask((group,))].mean())))
    count = 0

    def on_step(text: str) -> None:
        nonlocal count
        on_progress(text, count, 0)
        count += 1

    gate_result = gate(problem, before, fitted, told, on_step)
    accepted, impossible = gate_result.accepted, ()
    solution = _fit_accepted(problem, fitted, before, accepted)
    if READOUT in accepted and solution.camera[index_of("readout_s")] < 0:
        accepted, impossible = tuple(group for group in accepted if group != READOUT), (READOUT,)
        solution = _fit_accepted(problem, fitted, before, accepted)
    sigmas = standard_deviations(problem, solution, group_mask(accepted))
    camera = _possible(solution.camera, start)
    estimates = []
    for index, parameter in enumerate(PARAMETERS):
        taken = parameter.group in accepted
        verdict = _verdict(parameter.group, told, accepted, impossible)
        found, sigma = (solution.camera, sigmas) if taken else (fitted.camera, all_sigmas)
        estimates.append(
            Estimate(
                parameter.name,
                parameter.unit,
                float(before[index]),
                float(solution.camera[index]),
                float(found[index]),
                float(sigma[index]),
                verdict,
            )
        )
    of_scale = _estimated_scale(start, scale)
    estimates.append(of_scale)
    return Calibration(
        start=start,
        camera=_scaled(camera, of_scale),
        estimates=tuple(estimates),
        held_out_gain=float(1 - gate_result.after.costs.sum() / gate_result.before.costs.sum()),
        pixel_sigma=problem.noise.pixel,
        depth_sigma=problem.noise.depth,
        num_blocks=len(problem.blocks),
        num_frames=sum(block.num_frames for block in problem.blocks),
        rounds=rounds,
        residuals=_residual_field(problem, fitted, before, gate_result),
    )


def _fit_accepted(
    problem: BatchProblem, fitted: BatchSolution, before: CameraVector, accepted: tuple[str, ...]
) -> BatchSolution:
    free = group_mask(accepted)
    return solve_batch(problem, np.where(free, fitted.camera, before), fitted.states, free)


def _is_told(group: str, sigmas: CameraVector, prior: CameraVector) -> bool:
    own = group_mask((group,))
    return bool((sigmas[own] < _TOLD * prior[own]).any())


def _verdict(group: str, told: tuple[str, ...], accepted: tuple[str, ...], impossible: tuple[str, ...]) -> Verdict:
    if group in impossible:
        return Verdict.IMPOSSIBLE
    if group in accepted:
        return Verdict.NOT_IN_FILE if group == EXTRINSICS else Verdict.ACCEPTED
    return Verdict.NO_GAIN if group in told else Verdict.NOT_SHOWN


def _estimated_scale(start: Camera, scale: Scale | None) -> Estimate:
    """Return the length on which all others depend: no residual knows it, only what was measured outside."""
    name, unit, before = "depth_scale_per_m", "1/m", start.depth_scale_per_m
    value = np.nan if before is None else before
    if scale is None or before is None:
        return Estimate(name, unit, value, value, np.nan, np.nan, Verdict.UNOBSERVABLE)
    found = value / scale.factor
    sigma = found * scale.sigma / scale.factor
    differs = not abs(scale.factor - 1) <= _SURE_OF_SCALE * scale.sigma  # a length by hand has no deviation
    verdict = Verdict.ACCEPTED if differs else Verdict.NO_GAIN
    return Estimate(name, unit, value, found if differs else value, found, sigma, verdict)


def _scaled(camera: Camera, scale: Estimate) -> Camera:
    """Return a camera with another scale; an offset of depth is a length too."""
    if scale.verdict is not Verdict.ACCEPTED:
        return camera
    factor = scale.before / scale.after
    return replace(camera, depth_scale_per_m=scale.after, depth_offset_m=factor * camera.depth_offset_m)


def _possible(vector: CameraVector, start: Camera) -> Camera:
    """Return the nearest camera that a file can describe."""
    limited = vector.copy()
    size = np.array([start.width, start.height])
    limited[:2] = np.clip(limited[:2], size / 10, size * 20)
    limited[2:4] = np.clip(limited[2:4], 0.05 * size, 0.95 * size)
    for name, (least, most) in _LIMITS.items():
        limited[index_of(name)] = np.clip(limited[index_of(name)], least, most)
    return camera_of(limited, start)


def _residual_field(
    problem: BatchProblem, fitted: BatchSolution, before: CameraVector, gate_result: Gate
) -> ResidualField:
    """Return the residuals of held-out frames, of each half with the camera fitted to the other."""
    parts: list[tuple[np.ndarray, ...]] = []
    nothing = np.zeros(len(before), bool)
    for half in (0, 1):
        held = replace(problem, blocks=problem.blocks[1 - half :: 2])
        states = fitted.states[1 - half :: 2]
        both = [
            residuals_of_states(held, solve_batch(held, camera, states, nothing, max_steps=6))
            for camera in (before, gate_result.after.cameras[half])
        ]
        for block, first, second in zip(held.blocks, *both, strict=True):
            parts.append(_of_block(block, first, second))
    uv, first_px, second_px, depth, first_m, second_m = (
        np.concatenate(arrays, axis=-1) for arrays in zip(*parts, strict=True)
    )
    return ResidualField(uv, first_px, second_px, depth, first_m, second_m)


def _of_block(block: TrackBlock, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, ...]:
    seen, measured = block.seen, block.measured
    of_seen = lambda array: np.moveaxis(array, 1, 0)[:, seen]
    depth = 1 / block.depth.plane[:, 0][measured]
    # A small error of the inverse depth, in meters.
    to_m = -(depth**2) * block.depth.sigma[measured]
    pixels = of_seen(block.uv), of_seen(first[:, :2]), of_seen(second[:, :2])
    return *pixels, depth, first[:, 2][measured] * to_m, second[:, 2][measured] * to_m
