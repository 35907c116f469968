"""How long a mask survives without the detector: recordings with reference masks, and the overlap after some frames."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxslam.config.schema import Config, DynamicsConfig, SemanticsConfig
from jaxslam.datasets import Dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.geometry.se3 import angle, between, compose
from jaxslam.semantics import Detections
from jaxslam.semantics.detections import no_detections
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame, to_gray
from jaxslam.slam.mask_pipeline import MaskPipeline
from jaxslam.slam.slam import Slam

LEAD_IN, DETECT_EVERY = 15, 5
"""Number of frames before a start, in every fifth of which the detector finds what the reference shows."""
AFTER = (30, 60)
"""Numbers of frames after the last detection at which the mask is compared."""
_MIN_SHARE = 0.01
"""Smallest share of the image that the reference covers in a frame that counts."""


class Clip(NamedTuple):
    """Frames with their poses, and the reference masks of some of them.

    Attributes:
        camera: Camera of the frames.
        frames: The frames.
        T_world_cam: `(n, 7)` poses of the camera.
        reference: Function that returns the reference mask of a frame, given its number.
    """

    camera: Camera
    frames: list[Frame]
    T_world_cam: np.ndarray
    reference: Callable[[int], Bool[np.ndarray, "h w"]]


class Survival(NamedTuple):
    """Overlap of the mask with the reference.

    Attributes:
        starts: Frames of the last detection.
        iou: `(starts, len(AFTER))` intersection over union; NaN where the reference covers too little.
        precision: The share of the mask that the reference covers too.
        recall: The share of the reference that the mask covers too.
    """

    starts: np.ndarray
    iou: np.ndarray
    precision: np.ndarray
    recall: np.ndarray

    def medians(self) -> str:
        """Return the medians as text."""
        figures = zip(AFTER, self.iou.T, self.precision.T, self.recall.T, strict=True)
        return "; ".join(
            f"after {after}: IoU {np.nanmedian(iou):.2f} (quartiles {np.nanpercentile(iou, 25):.2f},"
            f" {np.nanpercentile(iou, 75):.2f}), precision {np.nanmedian(precision):.2f},"
            f" recall {np.nanmedian(recall):.2f}, starts {np.isfinite(iou).sum()}"
            for after, iou, precision, recall in figures
        )


class _Switched:
    """A detector that finds the reference in the frames that it is told, and nothing in others."""

    def __init__(self, clip: Clip) -> None:
        self._clip = clip
        self.shown: int | None = None

    def __call__(self, image: np.ndarray, /) -> Detections:
        if self.shown is None:
            return no_detections()
        return no_detections()._replace(class_mask=self._clip.reference(self.shown))


def survival(clip: Clip, starts: range, *, new_surfaces: bool, **semantics: object) -> Survival:
    """Measure how well the mask agrees with the reference without the detector, from each start.

    Args:
        clip: Frames with reference masks.
        starts: Numbers of the frames of the last detection; `LEAD_IN` frames come before each.
        new_surfaces: Whether new surfaces join the mask.
        semantics: Further settings of `semantics`.
    """
    settings = SemanticsConfig(latency_frames=0, dilate_px=0, **semantics)  # pyright: ignore[reportArgumentType]
    config = Config(semantics=settings, dynamics=DynamicsConfig(new_surfaces=new_surfaces))
    figures = np.full((3, len(starts), len(AFTER)), np.nan)
    for row, start in enumerate(starts):
        detector = _Switched(clip)
        pipeline = MaskPipeline(clip.camera, detector, config)
        for number in range(start - LEAD_IN, start + AFTER[-1] + 1):
            detected = number <= start and (start - number) % DETECT_EVERY == 0
            detector.shown = number if detected else None
            frame = clip.frames[number]
            assert frame.depth_m is not None
            found = pipeline.mask_frame(number, frame.image, to_gray(frame.image), frame.depth_m)
            if number - start in AFTER:
                figures[:, row, AFTER.index(number - start)] = _overlap(found.mask, clip.reference(number))
            pose, turn = clip.T_world_cam[number], _turn_rad_per_s(clip, number)
            pipeline.frame_tracked(number, frame.timestamp_ns * 1e-9, pose, turn)
        pipeline.close()
    return Survival(np.array(starts), *figures)


def _overlap(mask: np.ndarray, reference: np.ndarray) -> tuple[float, float, float]:
    if reference.mean() < _MIN_SHARE:
        return np.nan, np.nan, np.nan
    both, of_mask, of_reference = (np.count_nonzero(each) for each in (mask & reference, mask, reference))
    return both / (of_mask + of_reference - both), both / max(of_mask, 1), both / of_reference


def _turn_rad_per_s(clip: Clip, number: int) -> float:
    before = max(number - 1, 0)
    dt_s = (clip.frames[before + 1].timestamp_ns - clip.frames[before].timestamp_ns) * 1e-9
    return float(angle(between(clip.T_world_cam[before], clip.T_world_cam[before + 1]))) / dt_s


def tracked_clip(dataset: Dataset, num: int, reference: Callable[[np.ndarray], Bool[np.ndarray, "h w"]]) -> Clip:
    """Track the first frames of a recording for their poses.

    Args:
        dataset: The recording.
        num: Number of frames.
        reference: Segments an image; its masks are kept.
    """
    frames = [dataset[index] for index in range(num)]
    with Slam(dataset.camera, Config(semantics=SemanticsConfig(model=None))) as slam:
        poses = np.array([slam.track(frame).T_world_cam for frame in frames])
    masks: dict[int, np.ndarray] = {}

    def kept(number: int) -> np.ndarray:
        if number not in masks:
            masks[number] = reference(frames[number].image)
        return masks[number]

    return Clip(dataset.camera, frames, poses, kept)


def turned(clip: Clip) -> Clip:
    """Return a clip with its pictures turned by 180 degrees, as if the camera had been held upside down."""
    turn = lambda image: np.ascontiguousarray(image[::-1, ::-1])
    camera = clip.camera
    center = {"cx": camera.width - 1 - camera.cx, "cy": camera.height - 1 - camera.cy}
    k1, k2, p1, p2, k3 = camera.distortion
    upside_down = np.array([0.0, 0, 0, 1, 0, 0, 0])
    return Clip(
        replace(camera, **center, distortion=(k1, k2, -p1, -p2, k3)),
        [Frame(frame.timestamp_ns, turn(frame.image), turn(frame.depth_m)) for frame in clip.frames],
        compose(clip.T_world_cam, np.tile(upside_down, (len(clip.frames), 1))),
        lambda number: turn(clip.reference(number)),
    )


def rendered_clip(seed: int, num: int, *, people: int = 2, path: CameraPathKind = "xyz") -> Clip:
    """Render a room with walking people; their true masks and the true poses are known."""
    dataset = SyntheticDataset(SyntheticConfig(seed=seed, frames=num, people=people, path=path, width=320, height=240))
    rendered = [dataset.render(index) for index in range(num)]
    return Clip(
        dataset.camera,
        [each.measured for each in rendered],
        np.array([each.T_world_cam for each in rendered]),
        lambda number: rendered[number].instance_mask > 0,
    )
