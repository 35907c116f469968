"""People who walk before a camera, tracked with no masks, with the truth at once, and with the truth late."""

from collections.abc import Sequence
from typing import NamedTuple, get_args

import numpy as np
from small_scene import Clip

from jaxslam.config.loading import load_config
from jaxslam.datasets.synthetic import SceneDetector, SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.sensors.frame import Frame
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate

PATHS: tuple[CameraPathKind, ...] = tuple(path for path in get_args(CameraPathKind) if path != "loop")
LATE_FRAMES = 5
FLOOR_M = 0.002
"""Errors below this are not told apart: they are those of the tracker, not of masks."""


class Scene(NamedTuple):
    """A recording, rendered."""

    clip: Clip
    detector: SceneDetector
    share: float
    """Of the image that people cover, on average."""


class Errors(NamedTuple):
    """ATE in meters: without masks (preset `static`), and with true masks (preset `ngd-published`)."""

    static: float
    at_once: float
    late: float

    @property
    def late_ratio(self) -> float:
        """Late over at once, of errors that can be told apart."""
        return max(self.late, FLOOR_M) / max(self.at_once, FLOOR_M)

    @property
    def static_ratio(self) -> float:
        """No masks over masks at once, of errors that can be told apart."""
        return self.static / max(self.at_once, FLOOR_M)

    def __str__(self) -> str:
        static, at_once, late = (f"{1e3 * error:.2f}" for error in self)
        ratios = f"late / at once {self.late_ratio:.2f}, static / at once {self.static_ratio:.1f}"
        return f"{static:>8} {at_once:>8} {late:>8} mm   {ratios}"


def scene(config: SyntheticConfig) -> Scene:
    """Render a recording, every frame once."""
    dataset = SyntheticDataset(config)
    frames = [dataset.render(index) for index in range(len(dataset))]
    clip = Clip(dataset, [Frame(frame.timestamp_ns, frame.rgb, frame.depth_m) for frame in frames])
    share = float(np.mean([np.mean(frame.instance_mask > 0) for frame in frames]))
    return Scene(clip, SceneDetector(dataset, frames), share)


def errors(scene: Scene, overrides: Sequence[str] = (), dilations_px: Sequence[int] = (3,)) -> Errors:
    """Track a recording in the three ways; whoever has masks must not lose it.

    Args:
        scene: The recording.
        overrides: Of the presets.
        dilations_px: How far masks reach beyond the truth: the median of equally good masks. A single ATE is moved by
            any change of masks, up to one and a half times: with true masks at once, on `rpy` with one person, it is
            2.2, 3.3 and 3.5 mm with 3, 4 and 5 pixels.
    """

    def ate_m(latency_frames: int) -> float:
        late = [*overrides, f"semantics.latency_frames={latency_frames}"]
        return float(
            np.median([_ate_m(scene, "ngd-published", [*late, f"semantics.dilate_px={px}"]) for px in dilations_px])
        )

    return Errors(_ate_m(scene, "static", overrides), ate_m(0), ate_m(LATE_FRAMES))


def _ate_m(scene: Scene, preset: str, overrides: Sequence[str]) -> float:
    clip, masked = scene.clip, preset != "static"
    settings = load_config(preset, overrides=overrides)
    with Slam(clip.camera, settings, detector=scene.detector if masked else None) as slam:
        results = [slam.track(frame) for frame in clip.frames]
        slam.finish()
        assert not masked or all(result.status is not TrackStatus.LOST for result in results)
        assert not any(result.detector_error for result in results)
        assert clip.ground_truth is not None
        return evaluate(slam.trajectory, clip.ground_truth).ate_rmse_m
