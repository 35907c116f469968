"""What is new in the picture, by depth alone: boxes before walls, a room with nobody in it, people who come in."""

import functools
import itertools
from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import pytest
from small_scene import TRACK

from jaxslam.config.schema import Config, DynamicsConfig, SemanticsConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, SyntheticFrame
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.geometry.se3 import IDENTITY, angle, between, compose
from jaxslam.masks.background_depth import BackgroundSurfaces, SurfaceMemory, new_surfaces
from jaxslam.semantics.detections import no_detections
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.downscale import ImageGrid
from jaxslam.sensors.frame import Frame, to_gray
from jaxslam.slam.mask_pipeline import FrameMask, MaskPipeline, MaskSource
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

WIDTH, HEIGHT, SECONDS = 320, 240, 2.0
WALL_M, BOX_M = 3.0, 1.5
BOX = (slice(60, 160), slice(100, 180))
"""Rows and columns of a box before the wall."""
STEP_PX = 2
"""A pixel of the coarse size in those of the image."""
AGO_S = 0.27
MASKS = Config(semantics=SemanticsConfig(latency_frames=2, dilate_px=0), dynamics=DynamicsConfig(new_surfaces=True))
"""Settings of masks alone, not dilated, with new surfaces."""
TRACKER = Config(
    track=replace(TRACK, num_points=256, points_per_source=96, cell_px=16),
    semantics=SemanticsConfig(model=None),
    dynamics=DynamicsConfig(new_surfaces=True, cues=(), balance_regions=False),
)


def small_camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return Camera("small", width, height, 0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2)


def wall(shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    return np.full(shape, WALL_M, np.float32)


def with_box(depth: np.ndarray, box: tuple[slice, slice] = BOX, box_m: float = BOX_M) -> np.ndarray:
    depth = depth.copy()
    depth[box] = box_m
    return depth


def near_edges(box: np.ndarray, reach: int = STEP_PX) -> np.ndarray:
    """Pixels beside the outline of a mask."""
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return cv2.dilate(box.view(np.uint8), around) != cv2.erode(box.view(np.uint8), around)


class Watcher:
    """A camera that shows one depth image after the other."""

    def __init__(self, camera: Camera | None = None) -> None:
        self.camera = camera or small_camera()
        self.memory, self.frame = SurfaceMemory(ImageGrid.of(self.camera)), 0

    def look(
        self, time_s: float, depth: np.ndarray, pose: np.ndarray = IDENTITY, turn_rad_per_s: float = 0.0
    ) -> np.ndarray:
        """What is new in the next frame."""
        seen = self.memory.compare(time_s, pose, turn_rad_per_s, depth)
        mask = self.memory.with_new_surfaces(np.zeros(depth.shape, bool), seen)
        self.memory.remember(self.frame, time_s, pose, turn_rad_per_s, mask)
        self.frame += 1
        return mask


def after_a_wall(depth: np.ndarray, before: np.ndarray | None = None, turn_rad_per_s: float = 0.0) -> np.ndarray:
    """What is new in an image when there was a wall."""
    watcher = Watcher()
    watcher.look(0.0, wall() if before is None else before, turn_rad_per_s=turn_rad_per_s)
    return watcher.look(AGO_S, depth, turn_rad_per_s=turn_rad_per_s)


def is_box(mask: np.ndarray, box: tuple[slice, slice] = BOX) -> bool:
    """Whether a mask is that of the box, as exactly as the coarse size tells."""
    whole = np.zeros(mask.shape, bool)
    whole[box] = True
    return bool(((mask == whole) | near_edges(whole)).all())


class TestNewSurfaces:
    """Of surfaces as they are compared, at the coarse size."""

    SHAPE = (120, 160)
    ROWS, COLUMNS = slice(30, 80), slice(50, 90)

    def seen(
        self, *, new: np.ndarray, unmoved: np.ndarray | None = None, displaced_px: float = 0.0
    ) -> BackgroundSurfaces:
        depth = with_box(wall(self.SHAPE), (self.ROWS, self.COLUMNS))
        nothing = np.zeros(self.SHAPE, bool)
        standing = depth == WALL_M if unmoved is None else unmoved
        return BackgroundSurfaces(depth, nothing, nothing, standing, new, nothing, displaced_px)

    def area(self, rows: slice, columns: slice) -> np.ndarray:
        area = np.zeros(self.SHAPE, bool)
        area[rows, columns] = True
        return area

    def test_all_of_an_object_of_which_a_part_is_new(self) -> None:
        """Nothing could be compared in the rest: it hangs together with it, at the same depth."""
        box, part = self.area(self.ROWS, self.COLUMNS), self.area(self.ROWS, slice(50, 60))
        np.testing.assert_array_equal(new_surfaces(self.seen(new=part), np.zeros(self.SHAPE, bool)), box)

    def test_not_what_is_known_to_stand(self) -> None:
        part, rest = self.area(self.ROWS, slice(50, 70)), self.area(self.ROWS, slice(70, 90))
        seen = self.seen(new=part, unmoved=~part)
        assert rest.any()
        np.testing.assert_array_equal(new_surfaces(seen, np.zeros(self.SHAPE, bool)), part)

    def test_not_what_is_as_far_away_elsewhere(self) -> None:
        box, apart = self.area(self.ROWS, self.COLUMNS), self.area(slice(30, 80), slice(110, 150))
        seen = self.seen(new=box)
        seen.depth[apart] = BOX_M
        np.testing.assert_array_equal(new_surfaces(seen, np.zeros(self.SHAPE, bool)), box)

    def test_not_what_is_nearer_or_farther(self) -> None:
        box, beside = self.area(self.ROWS, self.COLUMNS), self.area(self.ROWS, slice(90, 120))
        for other_m in (BOX_M - 0.25, BOX_M + 0.25):
            seen = self.seen(new=box)
            seen.depth[beside] = other_m
            np.testing.assert_array_equal(new_surfaces(seen, np.zeros(self.SHAPE, bool)), box)

    def test_not_what_is_in_the_mask(self) -> None:
        box = self.area(self.ROWS, self.COLUMNS)
        assert not new_surfaces(self.seen(new=box), box).any()

    @pytest.mark.parametrize("displaced_px", [0.0, 1.0, 2.5, 3.5, 4.5, 5.5, 7.5])
    def test_exactly_the_object(self, displaced_px: float) -> None:
        """However fast the camera turns; also where nothing is known of what is beside it."""
        new = self.area(slice(30, 42), slice(50, 62))
        for beside_m in (0.0, WALL_M):
            depth = np.where(new, np.float32(BOX_M), np.float32(beside_m))
            nothing = np.zeros(self.SHAPE, bool)
            seen = BackgroundSurfaces(depth, nothing, nothing, nothing, new, nothing, displaced_px)
            np.testing.assert_array_equal(new_surfaces(seen, nothing), new)

    @pytest.mark.parametrize(("wide", "displaced_px"), [(2, 0.0), (5, 5.0), (9, 9.0)])
    def test_thin_edges(self, wide: int, displaced_px: float) -> None:
        """As wide as edges are displaced they are no new_surfaces; three times as wide they are."""
        none = np.zeros(self.SHAPE, bool)
        edge = self.area(self.ROWS, slice(50, 50 + wide))
        assert not new_surfaces(self.seen(new=edge, unmoved=~edge, displaced_px=displaced_px), none).any()
        broad = self.area(self.ROWS, slice(50, 50 + 3 * wide))
        np.testing.assert_array_equal(
            new_surfaces(self.seen(new=broad, unmoved=~broad, displaced_px=displaced_px), none), broad
        )

    def test_small_ones(self) -> None:
        none = np.zeros(self.SHAPE, bool)
        small, large = self.area(slice(30, 37), slice(50, 58)), self.area(slice(30, 38), slice(50, 58))
        assert small.sum() < 0.003 * small.size < large.sum()
        assert not new_surfaces(self.seen(new=small), none).any()
        np.testing.assert_array_equal(new_surfaces(self.seen(new=large, unmoved=~large), none), large)


class TestMemory:
    def test_box_before_a_wall(self) -> None:
        mask = after_a_wall(with_box(wall()))
        assert is_box(mask)
        assert is_box(after_a_wall(with_box(wall(), box_m=2.4)))
        assert not after_a_wall(wall()).any()

    def test_part_that_was_not_compared(self) -> None:
        """Depth was missing behind half of it."""
        before = wall()
        before[:, 130:] = 0
        assert is_box(after_a_wall(with_box(wall()), before))

    def test_what_goes_is_no_newcomer(self) -> None:
        assert not after_a_wall(wall(), with_box(wall())).any()

    def test_too_close_to_the_wall_to_tell(self) -> None:
        assert not after_a_wall(with_box(wall(), box_m=WALL_M - 0.2)).any()

    @pytest.mark.parametrize(("turn_rad_per_s", "is_new"), [(0.0, True), (0.5, True), (2.0, False)])
    def test_edge_of_a_camera_that_turns(self, turn_rad_per_s: float, is_new: bool) -> None:
        """A strip of 12 pixels; a box stays what it is."""
        strip = (slice(60, 160), slice(100, 112))
        assert after_a_wall(with_box(wall(), strip), turn_rad_per_s=turn_rad_per_s).any() == is_new
        assert is_box(after_a_wall(with_box(wall()), turn_rad_per_s=turn_rad_per_s))

    def test_camera_moves(self) -> None:
        """A wall is where it was, and a box is found where it is now."""
        watcher = Watcher()
        moved = np.array([1.0, 0, 0, 0, 0.2, -0.1, 0.4])
        watcher.look(0.0, wall())
        assert not watcher.look(AGO_S, np.full((HEIGHT, WIDTH), WALL_M - 0.4, np.float32), moved).any()
        # Where the wall was not in view nothing is known; the box is before what was.
        assert is_box(watcher.look(AGO_S + 0.01, with_box(wall() - np.float32(0.4)), moved))

    @pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
    def test_missing_depth(self, value: float) -> None:
        missing = np.full((HEIGHT, WIDTH), value, np.float32)
        assert not after_a_wall(missing).any()
        assert not after_a_wall(with_box(wall()), missing).any()
        holes = with_box(wall())
        holes[:, ::40] = value
        holes[:20] = value
        mask = after_a_wall(holes)
        inside = np.zeros_like(mask)
        inside[BOX] = True
        assert mask[inside].mean() > 0.8
        assert not mask[~inside & ~near_edges(inside)].any()

    def test_forgets(self) -> None:
        watcher = Watcher()
        watcher.look(0.0, wall())
        watcher.memory.forget()
        assert not watcher.look(AGO_S, with_box(wall())).any()

    def test_without_still_pixels(self) -> None:
        """Whole areas leave a mask; single pixels of the coarse size do not."""
        memory, everywhere = SurfaceMemory(ImageGrid.of(small_camera())), np.ones((HEIGHT, WIDTH), bool)
        drop = np.zeros((HEIGHT // STEP_PX, WIDTH // STEP_PX), bool)
        drop[5, 7] = True
        assert memory.without(everywhere, drop).all()
        drop[30:60, 40:80] = True
        left = memory.without(everywhere, drop)
        assert not left[64:116, 84:156].any()
        assert left[:56].all()
        assert left[:, :76].all()

    @pytest.mark.parametrize("size", [(321, 243), (32, 24), (641, 480), (240, 320), (8, 8), (1000, 31)])
    def test_sizes(self, size: tuple[int, int]) -> None:
        """Also those that are no multiple of the coarse size."""
        width, height = size
        box = (slice(height // 4, 3 * height // 4), slice(width // 4, 3 * width // 4))
        watcher = Watcher(small_camera(width, height))
        assert not watcher.look(0.0, wall((height, width))).any()
        mask = watcher.look(AGO_S, with_box(wall((height, width)), box))
        whole = np.zeros((height, width), bool)
        whole[box] = True
        assert mask.shape == (height, width)
        assert ((mask == whole) | near_edges(whole, 1 + width // 100)).all()
        assert mask[height // 2, width // 2]


class TestAppeared:
    """Who pauses has appeared before surfaces of some seconds ago, and stays in the mask."""

    def after(self, standing_s: float) -> tuple[SurfaceMemory, BackgroundSurfaces]:
        """A wall for a second, then a box before it for so long."""
        watcher, came_s, rate_hz = Watcher(), 1.0, 15
        for index in range(round((came_s + standing_s) * rate_hz)):
            watcher.look(index / rate_hz, with_box(wall()) if index / rate_hz >= came_s else wall())
        return watcher.memory, watcher.memory.compare(came_s + standing_s, IDENTITY, 0.0, with_box(wall()))

    @pytest.mark.parametrize(("standing_s", "has_appeared"), [(0.2, True), (1.5, True), (3.0, True), (6.0, False)])
    def test_for_some_seconds(self, standing_s: float, has_appeared: bool) -> None:
        box = with_box(wall())[1::2, 1::2] == BOX_M
        _, seen = self.after(standing_s)
        assert seen.still[box].all() == (standing_s > 0.5)
        assert seen.appeared[box].all() == has_appeared
        assert not seen.appeared[~box].any()

    @pytest.mark.parametrize(("columns", "comes_back"), [(30, True), (4, False), (0, False)])
    def test_comes_back_whole_if_the_mask_holds_enough_of_it(self, columns: int, comes_back: bool) -> None:
        """Of the 80 columns of the box."""
        memory, seen = self.after(1.5)
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[BOX[0], 100 : 100 + columns] = True
        again = memory.with_lost_parts(mask, seen)
        assert is_box(again) if comes_back else np.array_equal(again, mask)

    def test_memory_is_bounded(self) -> None:
        watcher = Watcher(small_camera(32, 24))
        for index in range(600):
            watcher.look(index / 60, wall((24, 32)))
        assert len(watcher.memory._seen) < 60 + 4 / 0.2 + 2

    def test_a_box_that_stops_stays_in_the_mask_without_the_detector(self) -> None:
        """It moves for two thirds of a second, is detected once, and stands for another two seconds."""
        rng = np.random.default_rng(0)
        background, texture = rng.integers(0, 255, (2, HEIGHT, WIDTH), dtype=np.uint8)
        found: list[np.ndarray] = []
        detector = lambda image: no_detections()._replace(class_mask=found.pop() if found else None)
        alone = replace(MASKS, semantics=replace(MASKS.semantics, latency_frames=0), dynamics=DynamicsConfig())
        pipeline, num = MaskPipeline(small_camera(), detector, alone), 110
        mask = where = np.zeros((HEIGHT, WIDTH), bool)
        for index in range(num):
            left = 5 * min(max(index - 30, 0), 20)
            box = (slice(60, 160), slice(left, left + 80))
            gray = cv2.GaussianBlur(background, (0, 0), 2)
            gray[box] = cv2.GaussianBlur(texture, (0, 0), 2)[60:160, :80]
            where = np.zeros((HEIGHT, WIDTH), bool)
            where[box] = True
            if index == 50:
                found.append(where)
            mask = pipeline.mask_frame(index, gray, gray, with_box(wall(), box)).mask
            pipeline.frame_tracked(index, index / 30, IDENTITY, 0.0)
        assert np.count_nonzero(mask & where) > 0.8 * np.count_nonzero(mask | where)


class TestTime:
    @pytest.mark.parametrize("rate_hz", [5, 15, 60])
    def test_decides_which_frame_is_compared(self, rate_hz: int) -> None:
        """A box is new until it stands in the frame of about a quarter of a second ago."""
        watcher, came_s = Watcher(), 1.0
        times_s = np.arange(round(2 * rate_hz)) / rate_hz
        for time_s in times_s:
            there = time_s >= came_s
            mask = watcher.look(time_s, with_box(wall()) if there else wall())
            apart_s = np.abs(times_s[times_s < time_s] - (time_s - AGO_S))
            compared_s = times_s[np.argmin(apart_s)] if len(apart_s) and apart_s.min() <= AGO_S / 2 else np.inf
            assert mask.any() == (there and compared_s < came_s), f"after {time_s:.3f} s"
            assert not mask.any() or is_box(mask)

    def test_nothing_was_seen_for_long(self) -> None:
        for gap_s, is_new in ((AGO_S, True), (0.45, False), (2.0, False)):
            watcher = Watcher()
            watcher.look(0.0, wall())
            assert watcher.look(gap_s, with_box(wall())).any() == is_new

    def test_goes_back(self) -> None:
        """A recording begun again."""
        watcher = Watcher()
        watcher.look(100.0, wall())
        watcher.look(0.0, wall())
        assert is_box(watcher.look(AGO_S, with_box(wall())))

    def test_seconds_since_1970(self) -> None:
        watcher, start_s = Watcher(), 1.6e9
        watcher.look(start_s, wall())
        assert is_box(watcher.look(start_s + AGO_S, with_box(wall())))


class TestCorrection:
    SHIFT = np.array([1.0, 0, 0, 0, 0.6, 0.0, -0.8])

    def seen(self, corrected: bool, moved: bool) -> np.ndarray:
        watcher = Watcher()
        rng = np.random.default_rng(0)
        depth = wall() + rng.uniform(0, 0.01, (HEIGHT, WIDTH)).astype(np.float32)
        watcher.look(0.0, depth)
        if corrected:
            watcher.memory.correct(self.SHIFT)
        return watcher.look(AGO_S, with_box(depth), compose(self.SHIFT, IDENTITY) if moved else IDENTITY)

    def test_of_a_metre_changes_nothing(self) -> None:
        np.testing.assert_array_equal(self.seen(corrected=True, moved=True), self.seen(corrected=False, moved=False))

    def test_is_needed(self) -> None:
        assert not is_box(self.seen(corrected=False, moved=True))


@functools.cache
def room(path: CameraPathKind, fps: float, people: int, seed: int, seconds: float = SECONDS) -> SyntheticDataset:
    frames = round(seconds * fps)
    return SyntheticDataset(
        SyntheticConfig(width=WIDTH, height=HEIGHT, frames=frames, people=people, path=path, fps=fps, seed=seed)
    )


@functools.cache
def rendered(
    path: CameraPathKind, fps: float = 30.0, people: int = 0, seed: int = 0, seconds: float = SECONDS
) -> tuple[SyntheticFrame, ...]:
    source = room(path, fps, people, seed, seconds)
    return tuple(source.render(index) for index in range(len(source)))


def masks_at_true_poses(source: SyntheticDataset, frames: tuple[SyntheticFrame, ...]) -> list[FrameMask]:
    """The masks that depth alone makes when it is known where the camera is."""
    masks = MaskPipeline(source.camera, None, MASKS)
    turns = np.array([angle(between(a.T_world_cam, b.T_world_cam)) for a, b in itertools.pairwise(frames)])
    turns = np.append(turns, turns[-1:]) * source.fps
    made = []
    for index, (frame, turn) in enumerate(zip(frames, turns.tolist(), strict=True)):
        known = (index, 1e-9 * frame.timestamp_ns)
        made.append(masks.mask_frame(index, frame.rgb, to_gray(frame.rgb), frame.depth_m))
        masks.frame_tracked(*known, frame.T_world_cam, turn)
    return made


CLIPS: list[tuple[CameraPathKind, float, float]] = [
    *((path, 30.0, SECONDS) for path in get_args(CameraPathKind)),
    ("rpy", 60.0, SECONDS),
    ("rpy", 10.0, 3.0),
    ("rpy", 7.0, 3.0),
    ("rpy", 5.0, 4.0),
    ("loop", 5.0, 4.0),
]


class TestRoomWithNobodyInIt:
    @pytest.mark.parametrize(
        ("path", "fps", "seconds"), [*CLIPS[:2], *(pytest.param(*clip, marks=pytest.mark.slow) for clip in CLIPS[2:])]
    )
    def test_nothing_is_new(self, path: CameraPathKind, fps: float, seconds: float) -> None:
        masks = masks_at_true_poses(room(path, fps, 0, 0, seconds), rendered(path, fps, seconds=seconds))
        assert [mask.mask.sum() for mask in masks] == [0] * len(masks)
        assert {(mask.source, mask.age) for mask in masks} == {(MaskSource.NONE, -1)}

    @pytest.mark.parametrize(
        ("path", "fps", "seconds"), [CLIPS[0], *(pytest.param(*clip, marks=pytest.mark.slow) for clip in CLIPS[1:])]
    )
    def test_nothing_is_new_to_the_tracker(self, path: CameraPathKind, fps: float, seconds: float) -> None:
        """Whose poses are not those of the truth, and worse with few frames a second."""
        with Slam(room(path, fps, 0, 0, seconds).camera, TRACKER) as slam:
            frames = rendered(path, fps, seconds=seconds)
            results = [slam.track(Frame(frame.timestamp_ns, frame.rgb, frame.depth_m)) for frame in frames]
        assert [result.dynamic_mask.sum() for result in results] == [0] * len(results)
        assert all(result.status is not TrackStatus.LOST for result in results)

    @pytest.mark.slow
    @pytest.mark.parametrize("size", [(321, 243), (32, 24)])
    def test_other_sizes(self, size: tuple[int, int]) -> None:
        source = SyntheticDataset(SyntheticConfig(width=size[0], height=size[1], frames=30, people=0, path="rpy"))
        masks = masks_at_true_poses(source, tuple(source.render(index) for index in range(30)))
        assert [mask.mask.sum() for mask in masks] == [0] * len(masks)


MORE_PEOPLE: list[tuple[CameraPathKind, int, int, int, int]] = [("static", 0, 2, 60, 70), ("xyz", 1, 1, 75, 88)]


class TestPeople:
    @pytest.mark.parametrize(
        ("path", "seed", "walker", "first", "last"),
        [("xyz", 0, 2, 60, 70), *(pytest.param(*clip, marks=pytest.mark.slow) for clip in MORE_PEOPLE)],
    )
    @pytest.mark.slow
    def test_are_found_when_they_come_in(
        self, path: CameraPathKind, seed: int, walker: int, first: int, last: int
    ) -> None:
        """No detector looks; the walker was hidden or out of view half a second before."""
        frames = rendered(path, 30.0, 2, seed, 3.0)
        masks = masks_at_true_poses(room(path, 30.0, 2, seed, 3.0), frames)
        assert (
            min(np.sum(frame.instance_mask == walker) for frame in frames[first - 20 : first]) < 0.02 * WIDTH * HEIGHT
        )
        recall = [masks[i].mask[frames[i].instance_mask == walker].mean() for i in range(first, last)]
        print(f"share of walker {walker} in the mask: median {np.median(recall):.2f}, least {min(recall):.2f}")
        assert np.median(recall) > 0.8
        assert min(recall) > 0.6
        assert {mask.source for mask in masks} == {MaskSource.NONE, MaskSource.DEPTH}
        assert {mask.age for mask in masks} == {-1}

    @pytest.mark.parametrize(
        ("path", "seed"),
        [
            ("xyz", 0),
            pytest.param("static", 0, marks=pytest.mark.slow),
            pytest.param("xyz", 1, marks=pytest.mark.slow),
        ],
    )
    def test_little_else_is(self, path: CameraPathKind, seed: int) -> None:
        frames = rendered(path, 30.0, 2, seed, 3.0)
        masks = masks_at_true_poses(room(path, 30.0, 2, seed, 3.0), frames)
        masked = sum(mask.mask.sum() for mask in masks)
        wrong = sum((mask.mask & (frame.instance_mask == 0)).sum() for mask, frame in zip(masks, frames, strict=True))
        print(f"{wrong} of {masked} masked pixels are nobody's")
        assert masked > 0
        assert wrong <= 0.01 * masked

    @pytest.mark.slow
    @pytest.mark.parametrize(("size", "least_overlap"), [((321, 243), 0.7), ((65, 49), 0.15), ((33, 25), 0.0)])
    def test_in_other_sizes(self, size: tuple[int, int], least_overlap: float) -> None:
        """In small pictures people are soon too small to be found, but no mask is wrong."""
        source = SyntheticDataset(
            SyntheticConfig(width=size[0], height=size[1], frames=16, people=2, path="xyz", seed=1)
        )
        frames = tuple(source.render(index) for index in range(16))
        masks = masks_at_true_poses(source, frames)
        truth = [frame.instance_mask > 0 for frame in frames]
        wrong = sum((mask.mask & ~people).sum() for mask, people in zip(masks, truth, strict=True))
        overlap = (masks[-1].mask & truth[-1]).sum() / (masks[-1].mask | truth[-1]).sum()
        print(f"{size}: overlap with the truth {overlap:.2f}, {wrong} pixels wrong")
        assert overlap >= least_overlap
        assert wrong <= 0.01 * sum(mask.mask.sum() for mask in masks)

    def test_twice_the_same(self) -> None:
        first, second = (
            masks_at_true_poses(room("xyz", 30.0, 2, 0, 3.0), rendered("xyz", 30.0, 2, 0, 3.0)[:30]) for _ in range(2)
        )
        assert any(mask.mask.any() for mask in first)
        assert [mask.mask.tobytes() for mask in first] == [mask.mask.tobytes() for mask in second]
