"""Masks of every frame: when they come, how old they are, and what goes wrong; the tracker with and without them."""

import functools
import itertools
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_scene import TRACK, Clip

from jaxslam.config.schema import Config, DynamicsConfig, RunConfig, SemanticsConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.errors import ModelError
from jaxslam.geometry.se3 import angle, between
from jaxslam.semantics import Detections, no_detections
from jaxslam.semantics.from_config import detector_of
from jaxslam.sensors.frame import to_gray
from jaxslam.slam.mask_pipeline import FrameMask, MaskPipeline, MaskSource
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate

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
    detector: Callable[[np.ndarray], Detections] | None,
    latency_frames: int = 2,
    *,
    deterministic: bool = True,
    propagate: bool = True,
    new_surfaces: bool = False,
    num: int = 12,
) -> list[FrameMask]:
    """The masks of the first frames, of a camera whose poses are known."""
    made = MaskPipeline(
        source().camera,
        detector,
        Config(
            run=RunConfig(deterministic=deterministic),
            semantics=SemanticsConfig(latency_frames=latency_frames, propagate=propagate, dilate_px=0),
            dynamics=DynamicsConfig(new_surfaces=new_surfaces),
        ),
    )
    try:
        return [mask_of(made, index) for index in range(num)]
    finally:
        made.close()


def mask_of(made: MaskPipeline, index: int, moved_to: np.ndarray | None = None, *, has_depth: bool = True) -> FrameMask:
    frame, time_s = rendered()[0].frames[index], float(1e-9 * source().timestamps_ns[index])
    pose: np.ndarray = source().T_world_cam[index] if moved_to is None else moved_to
    turn = float(turns()[index])
    assert frame.depth_m is not None
    depth_m = frame.depth_m if has_depth else np.zeros_like(frame.depth_m)
    mask = made.mask_frame(index, frame.image, to_gray(frame.image), depth_m)
    made.frame_tracked(index, time_s, pose, turn)
    made.submit_for_detection(index, frame.image)
    return mask


@functools.cache
def turns() -> np.ndarray:
    """`(n,)` rad/s."""
    angles = [float(angle(between(a, b))) for a, b in itertools.pairwise(source().T_world_cam)]
    return np.array([*angles, angles[-1]]) * source().fps


def overlaps(masks: list[FrameMask]) -> np.ndarray:
    truth = rendered()[1]
    return np.array([np.sum(m.mask & t) / max(np.sum(m.mask | t), 1) for m, t in zip(masks, truth, strict=False)])


class TestDepthNowAndThen:
    """Every third frame has depth."""

    def masks(self, latency_frames: int, num: int = 12) -> list[FrameMask]:
        settings = SemanticsConfig(latency_frames=latency_frames, dilate_px=0)
        made = MaskPipeline(source().camera, knows_all, Config(run=RunConfig(deterministic=True), semantics=settings))
        try:
            return [mask_of(made, index, has_depth=index % 3 == 0) for index in range(num)]
        finally:
            made.close()

    def test_masks_move_along(self) -> None:
        found = overlaps(self.masks(2))
        print("overlap with the truth:", np.round(found, 2))
        assert found.min() > 0.7

    @pytest.mark.parametrize("latency_frames", [0, 2])
    def test_the_detector_waits_for_depth(self, latency_frames: int) -> None:
        masks = self.masks(latency_frames)
        looked_at = {index - mask.age for index, mask in enumerate(masks)}
        assert {frame % 3 for frame in looked_at} == {0}

    def test_it_looks_again_when_depth_stays_away(self) -> None:
        made = MaskPipeline(source().camera, knows_all, Config(semantics=SemanticsConfig(latency_frames=0)))
        try:
            ages = [mask_of(made, index, has_depth=index == 0).age for index in range(20)]
        finally:
            made.close()
        assert ages == [*range(15), *[0] * 5]


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


def sees(until: int) -> Callable[[np.ndarray], Detections]:
    """A detector that is right for so many looks and then blind."""
    looks = itertools.count()
    return lambda image: knows_all(image) if next(looks) < until else no_detections()


class TestBlindDetector:
    def test_for_a_second(self) -> None:
        """People are followed on for thirty frames, a little better with what depth sees come."""
        last = {}
        for new_surfaces in (False, True):
            masks = masks_of(sees(6), 0, new_surfaces=new_surfaces, num=36)
            overlap = overlaps(masks)
            blind, last[new_surfaces] = overlap[6:], overlap[-1]
            print(f"new_surfaces {new_surfaces}: overlap with the truth {np.round(overlap[[5, 10, 15, 25, 35]], 2)}")
            assert overlap[5] > 0.9
            assert blind[:5].min() > 0.8
            assert np.median(blind) > 0.5
            assert blind.min() > 0.35
            assert [mask.age for mask in masks] == [0] * 6 + list(range(1, 31))
            assert {mask.source for mask in masks[6:]} == {MaskSource.PROPAGATED}
        assert last[True] >= last[False]

    def test_newcomers_are_added(self) -> None:
        """Whom depth sees come is in the mask, also if no detector has ever found anything."""
        masks = masks_of(lambda _: no_detections(), 0, new_surfaces=True, num=FRAMES)
        assert {mask.source for mask in masks} == {MaskSource.NONE, MaskSource.DEPTH}
        assert {mask.age for mask in masks} == {-1}
        truth = rendered()[1]
        wrong = sum((mask.mask & ~people).sum() for mask, people in zip(masks, truth, strict=True))
        assert wrong <= 0.01 * sum(mask.mask.sum() for mask in masks)

    def test_same_as_without_a_detector(self) -> None:
        blind, none = (masks_of(detector, 0, new_surfaces=True) for detector in (lambda _: no_detections(), None))
        assert any(mask.mask.any() for mask in none)
        for a, b in zip(blind, none, strict=True):
            np.testing.assert_array_equal(a.mask, b.mask)
            assert (a.source, a.age, a.error) == (b.source, b.age, b.error)


class TestWorld:
    """What is told of the camera's place."""

    @staticmethod
    def made() -> MaskPipeline:
        settings = SemanticsConfig(latency_frames=2, dilate_px=0)
        return MaskPipeline(
            source().camera, None, Config(semantics=settings, dynamics=DynamicsConfig(new_surfaces=True))
        )

    def test_corrected(self) -> None:
        """The world is moved by a meter between two frames: it is as if nothing had happened."""
        plain, corrected = self.made(), self.made()
        shift = np.array([1.0, 0, 0, 0, 0.8, 0.0, -0.6])
        here = np.concatenate([source().T_world_cam[:, :4], source().T_world_cam[:, 4:] + shift[4:]], axis=1)
        any_masked = []
        for index in range(FRAMES):
            if index == 8:
                corrected.apply_map_correction(shift)
            one, other = mask_of(plain, index), mask_of(corrected, index, here[index] if index >= 8 else None)
            assert (one.mask != other.mask).mean() < 1e-3  # where depth is just at the edge of a threshold
            assert one.mask.any() == other.mask.any()
            any_masked.append(one.mask.any())
        assert any_masked[-1]

    def test_lost(self) -> None:
        """Nothing is new to who does not know where it is: for 0.13 s there is nothing to compare with."""
        made = self.made()
        for index in range(4):
            mask_of(made, index)
        made.frame_lost(3)
        masks = [mask_of(made, index) for index in range(4, 16)]
        assert not any(mask.mask.any() for mask in masks[:4])
        assert masks[-1].mask.any()


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

    def test_is_told_once_and_logged_when_it_changes(self, caplog: pytest.LogCaptureFixture) -> None:
        words = ["", "no luck", "no luck", "", "no luck", "worse", "", "worse", "no luck", ""]
        looks = iter(words)

        def detector(image: np.ndarray) -> Detections:
            word = next(looks)
            if word:
                raise ValueError(word)
            return knows_all(image)

        masks = masks_of(detector, 0, num=len(words))
        assert [mask.error for mask in masks] == [word and f"ValueError: {word}" for word in words]
        assert [record.message for record in caplog.records] == [
            f"detector failed: ValueError: {word}" for word in ("no luck", "worse", "no luck")
        ]
        assert [mask.age for mask in masks] == [0, 1, 2, 0, 1, 2, 0, 1, 2, 0]

    @pytest.mark.parametrize("deterministic", [True, False])
    def test_no_failure_is_told_twice(self, deterministic: bool) -> None:
        looks, failures = itertools.count(), []

        def detector(image: np.ndarray) -> Detections:
            if (look := next(looks)) % 3 == 1:
                failures.append(f"ValueError: look {look}")
                raise ValueError(f"look {look}")
            return knows_all(image)

        told = [mask.error for mask in masks_of(detector, 2, deterministic=deterministic, num=FRAMES) if mask.error]
        assert len(told) >= 1
        assert told == failures[: len(told)]
        assert len(told) >= len(failures) - 1  # the last one may come too late

    @pytest.mark.parametrize(
        "changes",
        [
            {"boxes": np.zeros(4, np.float32)},
            {"boxes": np.zeros((3, 5), np.float32)},
            {"class_mask": np.ones((HEIGHT // 2, WIDTH // 2), bool)},
            {"class_mask": np.ones((HEIGHT, WIDTH, 1), bool)},
            {"class_mask": np.ones((HEIGHT, WIDTH), np.float32)},
            {"masks": np.ones((2, HEIGHT // 2, WIDTH // 2), bool)},
            {"boxes": None},
        ],
        ids=["one box", "five sides", "half the size", "three axes", "numbers", "masks of half the size", "nothing"],
    )
    def test_wrong_shapes(self, changes: dict[str, Any]) -> None:
        """Are told as what goes wrong; the mask of before is carried on."""
        looks = itertools.count()
        wrong = no_detections()._replace(**changes)
        masks = masks_of(lambda image: wrong if next(looks) else knows_all(image), 0, num=4)
        assert [bool(mask.error) for mask in masks] == [False, True, True, True]
        assert [mask.age for mask in masks] == [0, 1, 2, 3]
        assert overlaps(masks).min() > 0.6

    def test_no_detections_at_all(self) -> None:
        masks = masks_of(lambda _: None, 0, num=3)  # type: ignore[arg-type,return-value]
        assert all(mask.error.startswith("AttributeError") for mask in masks)
        assert not any(mask.mask.any() for mask in masks)

    @pytest.mark.parametrize("side", [0, 1, 2, 3])
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_boxes_that_are_no_numbers(self, side: int, value: float) -> None:
        """They are nobody; the others are found."""
        boxes = np.tile(np.array([[0, 0, WIDTH, HEIGHT]], np.float32), (2, 1))
        boxes[0, side] = value
        found = no_detections()._replace(boxes=boxes, scores=np.ones(2, np.float32), labels=("person",) * 2)
        both = masks_of(lambda _: found, 0, num=1)[0]
        alone = masks_of(lambda _: found._replace(boxes=boxes[1:]), 0, num=1)[0]
        assert not both.error
        assert alone.mask.any()
        np.testing.assert_array_equal(both.mask, alone.mask)
        assert not masks_of(lambda _: found._replace(boxes=boxes[:1]), 0, num=1)[0].mask.any()

    def test_detector_hangs(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The first frame waits for a while, the others not at all; closing does not wait for ever."""
        monkeypatch.setattr("jaxslam.slam.semantic_thread._PATIENCE_S", 0.05)
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


def config(*, new_surfaces: bool = True, **semantics: Any) -> Config:
    """Masks of every frame, and no cues."""
    dynamics = DynamicsConfig(new_surfaces=new_surfaces, cues=(), balance_regions=False)
    every = SemanticsConfig(model=None, frames="every", **semantics)
    return Config(track=PLAN, semantics=every, dynamics=dynamics)


class TestSlam:
    @pytest.mark.slow
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

    def test_callers_mask_where_there_is_no_other(self) -> None:
        clip, masks = rendered()
        for new_surfaces in (True, False):
            with Slam(clip.camera, config(new_surfaces=new_surfaces)) as slam:
                results = [slam.track(replace(clip[index], dynamic_mask=masks[index])) for index in range(3)]
            assert [(result.mask_source, result.mask_age) for result in results] == [(MaskSource.CALLER, -1)] * 3
            np.testing.assert_array_equal(results[-1].dynamic_mask, masks[2])

    def test_without_a_detector(self) -> None:
        """Masks are made nevertheless, unless the settings have none."""
        clip, truth = rendered()
        sources = {}
        for new_surfaces in (True, False):
            with Slam(clip.camera, config(new_surfaces=new_surfaces, dilate_px=0)) as slam:
                results = [slam.track(frame) for frame in clip.frames]
            sources[new_surfaces] = {result.mask_source for result in results}
            masked = sum(result.dynamic_mask.sum() for result in results)
            wrong = sum((r.dynamic_mask & ~people).sum() for r, people in zip(results, truth, strict=True))
            assert masked > 0 or not new_surfaces
            assert wrong <= 0.02 * masked
            assert {result.mask_age for result in results} == {-1}
        assert sources == {True: {MaskSource.NONE, MaskSource.DEPTH}, False: {MaskSource.NONE}}

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
        assert detector_of(SemanticsConfig(model=None)) is None

    def test_known_but_not_there(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: object, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setenv("JAXSLAM_MODELS", str(tmp_path))
        monkeypatch.setattr("jaxslam.semantics.model_zoo.models_dir", lambda: tmp_path)
        assert detector_of(SemanticsConfig(model="yolox-nano")) is None
        assert "jaxslam models get yolox-nano" in caplog.text

    @pytest.mark.parametrize("model", ["nowhere/there.onnx", "yolox-nanno"])
    def test_unknown(self, model: str) -> None:
        with pytest.raises(ModelError, match="expected"):
            detector_of(SemanticsConfig(model=model))
