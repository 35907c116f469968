"""Masks of every frame: when they come, how old they are, and what goes wrong; the tracker with and without them."""

import functools
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from small_scene import TRACK, Clip

from jaxslam.config import Config, SemanticsConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.detector_choice import detector_of
from jaxslam.dynamic_masks import DynamicMasks, FrameMask, MaskSource
from jaxslam.errors import ModelError
from jaxslam.evaluation import evaluate
from jaxslam.frame import to_grey
from jaxslam.semantics import Detections, no_detections
from jaxslam.slam import Slam
from jaxslam.state import TrackStatus

WIDTH, HEIGHT, FRAMES = 320, 240, 40
PLAN = replace(TRACK, num_points=256, points_per_source=96, cell_px=16)


@functools.cache
def source() -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=FRAMES, people=3))


@functools.cache
def rendered() -> tuple[Clip, tuple[np.ndarray, ...]]:
    """The room with people, and where they are."""
    frames = tuple(source().render(index) for index in range(FRAMES))
    clip = Clip(source(), [source()[index] for index in range(FRAMES)])
    return clip, tuple(frame.instance_mask > 0 for frame in frames)


def knows_all(image: np.ndarray) -> Detections:
    """A detector that is always right."""
    clip, masks = rendered()
    index = next(i for i, frame in enumerate(clip.frames) if np.array_equal(frame.image, image))
    return no_detections()._replace(class_mask=masks[index])


def masks_of(
    detector: Callable[[np.ndarray], Detections],
    latency_frames: int = 2,
    *,
    deterministic: bool = True,
    propagate: bool = True,
    num: int = 12,
) -> list[FrameMask]:
    made = DynamicMasks(
        source().camera,
        detector,
        deterministic=deterministic,
        latency_frames=latency_frames,
        propagate=propagate,
        dilate_px=0,
    )
    try:
        return [
            made.of_frame(i, f.image, to_grey(f.image), f.depth_m) for i, f in enumerate(rendered()[0].frames[:num])
        ]
    finally:
        made.close()


def overlaps(masks: list[FrameMask]) -> np.ndarray:
    truth = rendered()[1]
    return np.array([np.sum(m.mask & t) / max(np.sum(m.mask | t), 1) for m, t in zip(masks, truth, strict=False)])


class TestSchedule:
    def test_first_frame_waits_then_they_come_late(self) -> None:
        masks = masks_of(knows_all, 3)
        assert [mask.age for mask in masks] == [0, 1, 2, 3, 3, 4, 5, 3, 4, 5, 3, 4]
        detected = [mask.source is MaskSource.DETECTOR for mask in masks]
        assert np.flatnonzero(detected).tolist() == [0, 4, 7, 10]
        assert not any(mask.error for mask in masks)

    def test_every_frame_waits(self) -> None:
        masks = masks_of(knows_all, 0)
        assert {(mask.age, mask.source) for mask in masks} == {(0, MaskSource.DETECTOR)}
        np.testing.assert_array_equal(np.array([mask.mask for mask in masks]), rendered()[1][:12])

    def test_propagated_are_better_than_old_ones(self) -> None:
        new, old = overlaps(masks_of(knows_all, 3)), overlaps(masks_of(knows_all, 3, propagate=False))
        print(f"overlap with the truth {np.median(new):.3f}, left where they were {np.median(old):.3f}")
        assert np.median(new) > 0.7
        assert np.median(new) > np.median(old)

    def test_twice_the_same(self) -> None:
        first, second = (masks_of(knows_all, 2) for _ in range(2))
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a.mask, b.mask)

    def test_in_a_thread(self) -> None:
        masks = masks_of(knows_all, deterministic=False)
        assert masks[0].age == 0
        assert all(mask.source in (MaskSource.DETECTOR, MaskSource.PROPAGATED) for mask in masks)
        assert np.median(overlaps(masks)) > 0.7

    def test_no_people(self) -> None:
        masks = masks_of(lambda _: no_detections())
        assert {mask.source for mask in masks} == {MaskSource.NONE}
        assert not any(mask.mask.any() for mask in masks)

    def test_detector_stops_seeing(self) -> None:
        """What it has seen once is followed on."""
        looks = iter([True] + [False] * 100)
        masks = masks_of(lambda image: knows_all(image) if next(looks) else no_detections(), 1, num=10)
        assert {mask.source for mask in masks[1:]} == {MaskSource.PROPAGATED}
        assert overlaps(masks)[-1] > 0.4


class TestFailure:
    @pytest.mark.parametrize("deterministic", [True, False])
    def test_detector_raises(self, deterministic: bool) -> None:
        """Every failure is told, and the next frame is looked at nevertheless."""
        looks = iter(range(1000))

        def detector(image: np.ndarray) -> Detections:
            if next(looks) % 2:
                raise ValueError("no luck")
            return knows_all(image)

        masks = masks_of(detector, 1, deterministic=deterministic, num=FRAMES)
        assert any(mask.error == "ValueError: no luck" for mask in masks)
        assert sum(mask.source is MaskSource.DETECTOR for mask in masks) >= 1

    def test_detector_hangs(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The first frame waits for a while, the others not at all; closing does not wait for ever."""
        monkeypatch.setattr("jaxslam.dynamic_masks._FIRST_WAIT_S", 0.05)
        ends = threading.Event()

        def detector(image: np.ndarray) -> Detections:
            ends.wait(60)
            return no_detections()

        try:
            masks = masks_of(detector, deterministic=False, num=FRAMES)
        finally:
            ends.set()
        assert {(mask.source, mask.age) for mask in masks} == {(MaskSource.NONE, -1)}

    def test_many_boxes(self) -> None:
        rng = np.random.default_rng(0)
        boxes = np.sort(rng.uniform(-50, 400, (1000, 2, 2)), axis=1).reshape(-1, 4).astype(np.float32)
        found = no_detections()._replace(boxes=boxes, scores=np.ones(1000, np.float32), labels=("person",) * 1000)
        assert masks_of(lambda _: found, num=2)[0].mask.any()


def config(**semantics: object) -> Config:
    return Config(track=PLAN, semantics=SemanticsConfig(**semantics))  # type: ignore[arg-type]


class TestSlam:
    def test_people_do_not_matter(self) -> None:
        """Three people close to a moving camera: with masks as late as a network's, as good as with the truth."""
        errors = {}
        clip = rendered()[0]
        assert clip.ground_truth is not None
        for name, detector, latency in (("none", None, 2), ("late", knows_all, 3), ("at once", knows_all, 0)):
            with Slam(clip.camera, config(latency_frames=latency), detector=detector) as slam:
                results = [slam.track(frame) for frame in clip.frames]
                slam.finish()
                errors[name] = evaluate(slam.trajectory, clip.ground_truth).ate_rmse_m
            assert all(result.status is not TrackStatus.LOST for result in results)
            if detector is not None:
                assert results[-1].mask_source is not MaskSource.NONE
                assert 0 < results[-1].dynamic_ratio < 1
        print({name: f"{1e3 * error:.2f} mm" for name, error in errors.items()})
        assert errors["late"] <= 1.3 * errors["at once"] + 2e-4

    def test_callers_mask(self) -> None:
        clip, masks = rendered()
        with Slam(clip.camera, config()) as slam:
            result = slam.track(replace(clip[0], dynamic_mask=masks[0]))
        assert result.mask_source is MaskSource.CALLER
        np.testing.assert_array_equal(result.dynamic_mask, masks[0])

    def test_callers_mask_is_added_to_the_detectors(self) -> None:
        clip, masks = rendered()
        corner = np.zeros_like(masks[0])
        corner[:40, :40] = True
        with Slam(clip.camera, config(dilate_px=0), detector=knows_all) as slam:
            result = slam.track(replace(clip[0], dynamic_mask=corner))
        np.testing.assert_array_equal(result.dynamic_mask, corner | masks[0])

    def test_no_point_in_the_mask(self) -> None:
        clip = rendered()[0]
        with Slam(clip.camera, config(latency_frames=0), detector=knows_all) as slam:
            result = [slam.track(frame) for frame in clip.frames[:5]][-1]
        column, row = np.round(result.uv[:, result.weights > 0]).astype(int)
        assert len(column) > 50
        assert not result.dynamic_mask[row, column].any()

    def test_failure_is_in_the_output(self) -> None:
        def detector(image: np.ndarray) -> Detections:
            raise RuntimeError("out of order")

        clip = rendered()[0]
        with Slam(clip.camera, config(), detector=detector) as slam:
            results = [slam.track(frame) for frame in clip.frames[:3]]
        assert results[0].detector_error == "RuntimeError: out of order"
        assert all(result.status is not TrackStatus.LOST for result in results)


class TestDetectorOfSettings:
    def test_none(self) -> None:
        assert detector_of(SemanticsConfig()) is None

    def test_known_but_not_there(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: object, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setenv("JAXSLAM_MODELS", str(tmp_path))
        monkeypatch.setattr("jaxslam.known_models.models_dir", lambda: tmp_path)
        assert detector_of(SemanticsConfig(model="yolox-nano")) is None
        assert "jaxslam models get yolox-nano" in caplog.text

    @pytest.mark.parametrize("model", ["nowhere/there.onnx", "yolox-nanno"])
    def test_unknown(self, model: str) -> None:
        with pytest.raises(ModelError, match="expected"):
            detector_of(SemanticsConfig(model=model))
