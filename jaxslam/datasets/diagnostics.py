"""Sanity checks on a recording before tracking."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path

import numpy as np

from jaxslam.datasets import Associated, Dataset, frames_with_depth, open_dataset
from jaxslam.errors import JaxSlamError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.depth_checks import contradiction_of_depth, is_plausible
from jaxslam.sensors.frame import Frame, to_gray
from jaxslam.sensors.image_checks import image_fault
from jaxslam.sensors.stereo_checks import look_over
from jaxslam.trajectory.trajectory import associate

_SAMPLED_PAIRS = 8
_MANY_WITHOUT_DEPTH = 0.1
"""Share of frames; of fr1/desk 7 % have no depth image."""
_USUAL_DEPTH_SCALES = (1000.0, 5000.0)  # counts per meter: millimeters; TUM and Bonn


class Level(StrEnum):
    """Severity of a finding."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        level: Its severity.
        topic: Its topic in a word.
        text: Result of the check and, if it is unusual, its effect on tracking.
    """

    level: Level
    topic: str
    text: str

    def __str__(self) -> str:
        return f"{self.level:<8} {self.topic:<13} {self.text}"


@dataclass(frozen=True)
class Diagnosis:
    """The results of all checks; as text, one line per finding and a last line with their counts.

    Attributes:
        findings: The findings in the order of the checks.
    """

    findings: tuple[Finding, ...]

    def at(self, level: Level) -> list[Finding]:
        """Return the findings of one level."""
        return [finding for finding in self.findings if finding.level is level]

    @property
    def ok(self) -> bool:
        """Whether no finding prevents tracking; there may be warnings."""
        return not self.at(Level.ERROR)

    def __str__(self) -> str:
        errors, warnings = len(self.at(Level.ERROR)), len(self.at(Level.WARNING))
        return "\n".join([*map(str, self.findings), f"errors: {errors}, warnings: {warnings}"])


def diagnose(path: str | Path, kind: str = "auto", camera: Camera | str | Path | None = None) -> Diagnosis:
    """Check a recording, decoding a few frames of it; whatever is wrong inside the folder becomes a finding.

    Args:
        path: The folder, as for `open_dataset`.
        kind: The kind of recording, as for `open_dataset`.
        camera: The camera, as for `open_dataset`.

    Raises:
        DatasetError: If there is no such folder, and so nothing to check.
    """
    try:
        dataset = open_dataset(path, kind, camera)
    except JaxSlamError as error:
        if not Path(path).expanduser().is_dir():
            raise
        return Diagnosis((Finding(Level.ERROR, "recording", str(error)),))
    frames, unreadable = _sample(dataset)
    return Diagnosis(
        (
            _contents(dataset),
            *_timing(dataset),
            *_association(dataset),
            *_frames_without_depth(dataset),
            *_calibration(dataset.camera),
            *unreadable,
            *_images(frames),
            *_depth([frame.depth_m for frame in frames if frame.depth_m is not None], dataset.camera.depth_scale_per_m),
            *(
                _graded(found.odd, found.topic, found.text, found.consequence)
                for found in look_over(frames[:: len(frames) // 3 or 1], dataset.camera)
            ),
            _ground_truth(dataset),
        )
    )


def _graded(odd: bool, topic: str, text: str, consequence: str) -> Finding:
    return Finding(Level.WARNING, topic, f"{text}: {consequence}") if odd else Finding(Level.OK, topic, text)


def _contents(dataset: Dataset) -> Finding:
    camera = dataset.camera
    text = f"{dataset.name}: {len(dataset)} frames of {camera.width}x{camera.height}, camera {camera.name}"
    return _graded(len(dataset) < 2, "recording", text, "one frame makes no trajectory")


def _timing(dataset: Dataset) -> Iterator[Finding]:
    stamps = dataset.timestamps_ns
    steps = np.diff(stamps) / 1e9
    if not steps.size:
        return
    step, longest = float(np.median(steps)), int(np.argmax(steps))
    rate, nominal = 1 / step, dataset.camera.fps
    text = f"{(stamps[-1] - stamps[0]) / 1e9:.2f} s at {rate:.1f} frames a second"
    yield _graded(
        abs(rate / nominal - 1) > 0.2,
        "rate",
        text,
        f"camera '{dataset.camera.name}' says {nominal:g}; frames may be missing, or times in another unit",
    )
    gaps = int(np.sum(steps > 2.5 * step))
    text = f"{gaps} gaps longer than 2.5 frames, the longest {steps[longest]:.3f} s after frame {longest}"
    yield _graded(steps[longest] > 5 * step, "gaps", text, "the camera may move too far in between to be tracked on")


def _association(dataset: Dataset) -> Iterator[Finding]:
    if not isinstance(dataset, Associated):
        return
    color, depth = dataset.unmatched
    first, second = ("left", "right") if dataset.camera.is_stereo else ("color", "depth")
    text = f"{color} {first} and {depth} {second} images have no partner in time and are left out"
    share = max(color, depth) / (len(dataset) + max(color, depth))
    yield _graded(share > 0.05, "association", text, "fewer frames, more motion between them; is it the same clock?")


def _frames_without_depth(dataset: Dataset) -> Iterator[Finding]:
    missing = ~frames_with_depth(dataset)
    if missing.any():
        text = f"{missing.sum()} of {len(dataset)} frames have no depth image and are tracked without"
        many = missing.mean() > _MANY_WITHOUT_DEPTH
        yield _graded(bool(many), "depth images", text, "a pose without depth is less certain")


def _calibration(camera: Camera) -> Iterator[Finding]:
    view = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
    off_x = abs(camera.cx - (camera.width - 1) / 2) / camera.width
    off_y = abs(camera.cy - (camera.height - 1) / 2) / camera.height
    oddities = [
        (not 30 <= view <= 120, f"a field of view of {view:.0f} degrees (is fx of another image size?)"),
        (abs(camera.fx / camera.fy - 1) > 0.05, f"fx {camera.fx:g} and fy {camera.fy:g} far apart"),
        (max(off_x, off_y) > 0.1, f"a principal point ({camera.cx:g}, {camera.cy:g}) far from the center"),
        (not _is_monotonic(camera), "a distortion that folds the image over inside its corners"),
    ]
    odd = [text for is_odd, text in oddities if is_odd]
    text = f"field of view {view:.0f} degrees" if not odd else " and ".join(odd)
    yield _graded(bool(odd), "calibration", text, "a wrong calibration bends the trajectory, silently")


def _is_monotonic(camera: Camera) -> bool:
    """Whether the distorted radius grows with the undistorted one, out to the farthest corner."""
    k1, k2, _, _, k3 = camera.distortion
    x = max(camera.cx, camera.width - camera.cx) / camera.fx
    y = max(camera.cy, camera.height - camera.cy) / camera.fy
    r2 = np.linspace(0, np.hypot(x, y), 100) ** 2
    return bool(np.all(1 + 3 * k1 * r2 + 5 * k2 * r2**2 + 7 * k3 * r2**3 > 0))


def _sample(dataset: Dataset) -> tuple[list[Frame], list[Finding]]:
    """Decode neighboring frames at a few places; each unreadable frame gives a finding."""
    starts = np.linspace(0, max(len(dataset) - 2, 0), _SAMPLED_PAIRS).astype(int)
    frames, findings = [], []
    for index in sorted({int(i) for start in starts for i in (start, start + 1) if i < len(dataset)}):
        try:
            frames.append(dataset[index])
        except JaxSlamError as error:
            findings.append(Finding(Level.ERROR, "frame", f"frame {index}: {error}"))
    return frames, findings


def _images(frames: Sequence[Frame]) -> Iterator[Finding]:
    grays = [to_gray(frame.image) for frame in frames]
    if not grays:
        return
    faults = Counter(fault for fault in map(image_fault, grays) if fault)
    if repeated := sum(np.array_equal(one, other) for one, other in pairwise(grays)):
        faults["the same as the one before"] = repeated
    odd = [f"{count} {fault}" for fault, count in faults.items()]
    text = f"{', '.join(odd) or 'sharp and well lit'}, of {len(grays)} sampled"
    yield _graded(bool(odd), "images", text, "such frames give the tracker few points or none")


def _depth(depths: Sequence[np.ndarray], scale: float | None) -> Iterator[Finding]:
    if not depths:
        return
    pixels = np.stack(depths)[:, ::4, ::4]
    measured = pixels[np.isfinite(pixels) & (pixels > 0)]
    missing = 1 - measured.size / pixels.size
    if not measured.size:
        yield Finding(Level.ERROR, "depth", "no sampled frame has any depth: nothing can be tracked")
        return
    yield _graded(missing > 0.5, "depth", f"{missing:.0%} missing", "too few points have depth to track well")
    near, median, far = np.percentile(measured, (2, 50, 98))
    text = f"median {median:.2f} m, 96 % between {near:.2f} and {far:.2f} m"
    if scale is not None:
        text += f", at {scale:g} counts a meter"
    contradiction = next(filter(None, map(contradiction_of_depth, depths)), "")
    yield _graded(
        bool(contradiction) or not is_plausible(near, median, far),
        "depth scale",
        text,
        f"{contradiction or 'odd for an RGB-D camera'}; {_likely_scale(near, median, far, scale)}the map gets the"
        " wrong size",
    )


def _likely_scale(near: float, median: float, far: float, scale: float | None) -> str:
    ratios = {usual: scale / usual for usual in _USUAL_DEPTH_SCALES} if scale is not None else {}
    likely = [f"{u:g}" for u, ratio in ratios.items() if is_plausible(near * ratio, median * ratio, far * ratio)]
    return f"depth_scale_per_m is rather {' or '.join(likely)}; " if likely else ""


def _ground_truth(dataset: Dataset) -> Finding:
    try:
        truth = dataset.ground_truth
    except JaxSlamError as error:
        return Finding(Level.ERROR, "ground truth", str(error))
    if truth is None:
        return Finding(Level.OK, "ground truth", "none: it can be tracked, but not evaluated")
    covered = len(associate(dataset.timestamps_ns, truth.timestamps_ns)[0]) / len(dataset)
    path = float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum())
    text = f"{len(truth)} poses, path {path:.2f} m; {covered:.0%} of frames have one within 20 ms"
    return _graded(covered < 0.9, "ground truth", text, "errors are measured on part of the recording only")
