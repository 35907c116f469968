"""Tracking a rendered recording with true masks: the setting `semantics.model: scene`."""

import numpy as np

from jaxslam.config.schema import SemanticsConfig
from jaxslam.datasets.prefetch import Subset
from jaxslam.datasets.protocol import Dataset, imu_samples, imu_sheet
from jaxslam.datasets.synthetic.ground_truth_detector import LabeledRecording, SceneDetector
from jaxslam.errors import ConfigError
from jaxslam.semantics.from_config import SCENE
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.trajectory.trajectory import Trajectory


def with_true_masks(dataset: Dataset, config: SemanticsConfig) -> tuple[Dataset, SceneDetector | None]:
    """Recording to track, and the detector of moving objects where the settings ask for the ground truth.

    `labels` say of what: `[person]` is a perfect network that is blind to boxes and cars, `[person, box]` knows all
    that moves in a room.

    Args:
        dataset: Recording to track.
        config: The settings.

    Returns:
        The same frames, which the detector now knows without rendering them once more, and the detector. With any
        other `model`, the recording as it is, and `None`.

    Raises:
        ConfigError: If that is no rendered room or world, nor a part of one, if a label is unknown, or if masks shall
            be made by prompts, which has nothing to add to the truth.
    """
    if config.model != SCENE:
        return dataset, None
    part = isinstance(dataset, Subset)
    room, indices = (dataset.whole, dataset.indices) if part else (dataset, range(len(dataset)))
    if not isinstance(room, LabeledRecording):
        raise ConfigError(
            f"semantics.model: '{SCENE}' expected a rendered room or world, got the recording {dataset.name}"
        )
    for key in ("prompt_encoder", "prompt_decoder", "examples"):
        if (value := getattr(config, key)) is not None:
            raise ConfigError(f"semantics.{key}: expected null with semantics.model={SCENE}, got '{value}'")
    detector = SceneDetector(room, labels=config.labels)
    return _Noted(dataset, room, indices, detector), detector


class _Noted:
    """A rendered recording or a part of one; the detector is told of what is rendered."""

    def __init__(self, dataset: Dataset, room: LabeledRecording, indices: range, detector: SceneDetector) -> None:
        self._room, self._indices, self._detector = room, indices, detector
        self.name: str = dataset.name
        self.camera: Camera = dataset.camera
        self.timestamps_ns: np.ndarray = dataset.timestamps_ns
        self.ground_truth: Trajectory | None = dataset.ground_truth
        self.imu: ImuSheet | None = imu_sheet(dataset)
        self.imu_samples: ImuSamples | None = imu_samples(dataset)
        self._part = dataset if isinstance(dataset, Subset) else None

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: int) -> Frame:
        rendered = self._room.render(self._indices[index])
        self._detector.note(rendered)
        frame = rendered.measured
        return frame if self._part is None else self._part.with_samples(range(len(self))[index], frame)
