"""Inputs that are wrong are named within ten frames; those that are right are not."""

import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from raw_pairs import RawRoom
from small_scene import CONFIG, clip

from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.errors import CameraError, ConfigError, DatasetError, FrameError
from jaxslam.map.types import Map, empty_map
from jaxslam.semantics import load_detector
from jaxslam.semantics.checked_detector import CheckedDetector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.depth_checks import contradiction_of_depth
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.image_checks import scaled_to_one
from jaxslam.sensors.stereo_rig import Lens, Rig
from jaxslam.slam.input_checks import InputChecks
from jaxslam.slam.input_warnings import InputWarnings
from jaxslam.slam.slam import Slam

MODELS = os.environ.get("JAXSLAM_MODELS")  # before it is hidden from tests
FRAMES = 10
COMPOSITE_CAMERA = Path(__file__).parents[3] / "configs" / "benchmarks" / "cameras" / "kitchen_people.yaml"
LENS = Lens(640, 480, 525.0, 525.0, 319.5, 239.5)


class Trackers:
    """A tracker that is reset, and a map that it made."""

    def __init__(self) -> None:
        self.slam = Slam(clip().camera, CONFIG)
        self.tracked(clip().frames[:FRAMES])
        self.slam.finish()
        self.map: Map = self.slam.map

    def tracked(self, frames: Iterable[Frame]) -> str:
        """What is said of frames, in the results of the frames themselves."""
        self.slam.reset()
        return "\n".join(text for frame in frames for text in self.slam.track(frame).warnings)

    def depth(self, change: Callable[[np.ndarray], np.ndarray]) -> str:
        """What is said of frames with another depth."""
        frames = clip().frames[:FRAMES]
        return self.tracked(replace(frame, depth_m=change(depth_of(frame))) for frame in frames)

    def of_map(self, **changes: object) -> str:
        """What is said of a map that a camera with some changes made."""
        camera = replace(clip().camera, **changes)  # pyright: ignore[reportArgumentType]
        with Slam(clip().camera, CONFIG, slam_map=self.map._replace(camera=camera)) as slam:
            return "\n".join(slam.track(clip().frames[0]).warnings)


@pytest.fixture(scope="module")
def trackers() -> Trackers:
    return Trackers()


def depth_of(frame: Frame) -> np.ndarray:
    assert frame.depth_m is not None
    return frame.depth_m


def seen(camera: Camera, frames: Iterable[Frame]) -> str:
    """What is said of frames when they are looked at, without tracking."""
    warnings = InputWarnings()
    watch = InputChecks(camera, warnings, None)
    for frame in islice(frames, FRAMES):
        watch.look(frame)
    return "\n".join(warnings.all)


def pairs(frames: int = FRAMES, seed: int = 0) -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(frames=frames, people=0, seed=seed, baseline_m=0.1))


def right_of(frame: Frame) -> np.ndarray:
    assert frame.right is not None
    return frame.right


def raised(error: type[Exception], work: Callable[[], object]) -> str:
    with pytest.raises(error) as caught:
        work()
    return str(caught.value)


def swapped_pairs(trackers: Trackers) -> str:
    room = pairs(1)
    return seen(room.camera, [replace(room[0], image=right_of(room[0]), right=room[0].image)])


def same_twice(trackers: Trackers) -> str:
    room = pairs(1)
    return seen(room.camera, [replace(room[0], right=room[0].image)])


def not_rectified(trackers: Trackers) -> str:
    raw = RawRoom(frames=1)
    left, right = raw.images(0)
    return seen(pairs(1).camera, [Frame(0, left, right=right)])


def rig_in_millimeters(trackers: Trackers) -> str:
    return raised(CameraError, lambda: Rig("rig", LENS, LENS, (1.0, 0.0, 0.0, 0.0, 110.0, 0.0, 0.0)))


def image_to_one(trackers: Trackers) -> str:
    image = clip().frames[0].image
    return raised(FrameError, lambda: replace(clip().frames[0], image=(image / 255).astype(np.float32)))


def image_to_one_uint8(trackers: Trackers) -> str:
    frames = clip().frames[:FRAMES]
    return trackers.tracked(replace(frame, image=np.rint(frame.image / 255).astype(np.uint8)) for frame in frames)


def recording_of_another_camera(trackers: Trackers) -> str:
    recording = clip()
    recording.camera = replace(recording.camera, fx=75.0, fy=75.0)
    trackers.slam.reset()
    return raised(DatasetError, lambda: trackers.slam.run(recording))


def other_size(trackers: Trackers) -> str:
    frame = clip().frames[0]
    small = Frame(frame.timestamp_ns, frame.image[::2, ::2], depth_of(frame)[::2, ::2])
    return raised(FrameError, lambda: trackers.tracked([small]))


WRONG: dict[str, tuple[Callable[[Trackers], str], str]] = {
    "left and right swapped": (swapped_pairs, "right: .* left and right are swapped"),
    "the left image twice": (same_twice, "right: .* got the left image twice"),
    "pair not rectified": (not_rectified, r"right: .* got matches \d+\.\d pixels off their rows"),
    "baseline of 100 m": (
        lambda _: raised(CameraError, lambda: replace(pairs(1).camera, baseline_m=100.0)),
        r"Camera\.baseline_m: expected a baseline in meters, at most 10, got 100 \(millimeters\?\)",
    ),
    "rig in millimeters": (rig_in_millimeters, r"T_left_right: .* at most 10, got 110 \(millimeters\?\)"),
    "depth in millimeters": (
        lambda to: to.depth(lambda depth: np.rint(1000 * depth).astype(np.float32)),
        "depth_m: expected meters .* whole numbers .* look like millimeters",
    ),
    "depth as counts": (
        lambda to: to.depth(lambda depth: np.rint(5000 * depth).astype(np.float32)),
        "depth_m: .* or counts of the depth image",
    ),
    "depth 5 times too large": (lambda to: to.depth(lambda depth: 5 * depth), "depth_m: .* 5 times too large"),
    "depth 5 times too small": (lambda to: to.depth(lambda depth: depth / 5), "depth_m: .* 5 times too small"),
    "depth 1000 times too large": (lambda to: to.depth(lambda depth: 999.9 * depth), "depth_m: .* 1000 times off"),
    "depth 1000 times too small": (lambda to: to.depth(lambda depth: depth / 1000), "depth_m: .* 1000 times off"),
    "image from 0 to 1": (image_to_one, "image: expected .* uint8, got float32; scale it to 0 to 255"),
    "image of 0 and 1": (image_to_one_uint8, "image: expected values from 0 to 255, got 0 and 1 only"),
    "camera of another size": (other_size, "image: expected the camera's 160x120 pixels, got 80x60"),
    "map of another focal length": (
        lambda to: to.of_map(fx=1.2 * clip().camera.fx, fy=1.2 * clip().camera.fy),
        r"camera: expected the map's, .* fx 157\.5 and 131\.2",
    ),
    "map of another lens": (lambda to: to.of_map(distortion=(-0.3, 0.1, 0.0, 0.0, 0.0)), "the map's, .* k1 -0.3 and 0"),
    "recording of another camera": (
        recording_of_another_camera,
        r"dataset\.camera: expected the tracker's camera, .* fx 131\.2 and 75\.0",
    ),
    "localize_only without a map": (
        lambda _: raised(ConfigError, lambda: Slam(clip().camera, CONFIG, localize_only=True)),
        "localize_only: needs the map to localize in.* got no map",
    ),
    "localize_only in an empty map": (
        lambda _: raised(
            ConfigError, lambda: Slam(clip().camera, CONFIG, slam_map=empty_map(clip().camera), localize_only=True)
        ),
        "localize_only: needs the map to localize in.* got a map without keyframes",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_input_is_named(trackers: Trackers, kind: str) -> None:
    provoke, words = WRONG[kind]
    text = provoke(trackers)
    assert "\n" not in text
    assert len(text) <= 300
    assert re.search(words, text), text


def test_right_input_is_not_named(trackers: Trackers) -> None:
    assert trackers.tracked(clip().frames[:FRAMES]) == ""
    assert trackers.of_map() == ""


def test_only_first_frames_and_every_hundredth_are_looked_at() -> None:
    """Each look takes time; a sensor that changes its unit on the way is noticed all the same."""
    frame = clip().frames[0]
    wrong = replace(frame, depth_m=1000 * depth_of(frame))
    warnings = InputWarnings()
    watch = InputChecks(clip().camera, warnings, None)
    named_at = []
    for number in range(101):
        watch.look(frame if number < FRAMES else wrong)
        named_at += [number] * len(warnings.taken())
    assert named_at == [100]


def test_no_depth_in_the_first_frames() -> None:
    """Depth now and then is enough; a camera without any cannot start."""
    blind = [replace(frame, depth_m=None) for frame in clip().frames[:FRAMES]]
    assert seen(clip().camera, blind) == "depth_m: expected depth now and then to start with, got none so far"
    assert seen(clip().camera, [*blind[1:], clip().frames[FRAMES - 1]]) == ""


def test_small_changes_of_a_map_camera_are_not_named(trackers: Trackers) -> None:
    """Two calibrations of one camera."""
    assert trackers.of_map(fx=1.003 * clip().camera.fx, cx=clip().camera.cx + 0.3) == ""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scale", [1.0, 10.0, 1 / 3], ids=["room", "ten times", "a third"])
@pytest.mark.parametrize("farthest_m", [np.inf, 2.0], ids=["all", "cut"])
def test_rooms_are_not_named(seed: int, scale: float, farthest_m: float) -> None:
    """Worlds of other sizes too, and depth that ends near by."""
    room = SyntheticDataset(SyntheticConfig(frames=60, width=160, height=120, seed=seed))
    depths = [depth_of(room[index]) for index in (0, 59)]
    assert [contradiction_of_depth(scale * np.where(depth > farthest_m, 0, depth)) for depth in depths] == ["", ""]


@pytest.mark.parametrize("seed", range(2))
def test_rooms_of_pairs_are_not_named(seed: int) -> None:
    room = pairs(2, seed)
    assert seen(room.camera, [room[0], room[1]]) == ""


REAL = (
    "tum/rgbd_dataset_freiburg1_rpy_excerpt",
    "bonn/rgbd_bonn_crowd",
    "composite/kitchen_people",
    "kitti/sequences/06",
)


@pytest.mark.parametrize("path", REAL)
def test_recordings_are_not_named(data_dir: Path, path: str) -> None:
    dataset = open_dataset(data_dir / path, camera=COMPOSITE_CAMERA if "kitchen" in path else None)
    for start in (0, len(dataset) // 2):
        frames = [dataset[index] for index in range(start, start + 4)]
        assert seen(dataset.camera, frames) == ""


def test_recording_of_a_stereo_depth_camera_is_not_named(data_dir: Path) -> None:
    for folder in ("depth", "aligned_depth"):
        file = min((data_dir / "openloris" / "sample" / folder).glob("*.png"))
        counts = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert counts is not None
        assert contradiction_of_depth(counts.astype(np.float32) / 1000) == ""


@pytest.mark.parametrize("path", REAL[:2])
def test_real_depth_five_times_off_is_named(data_dir: Path, path: str) -> None:
    dataset = open_dataset(data_dir / path)
    for factor in (5.0, 0.2):
        depth = np.float32(factor) * depth_of(dataset[0])
        assert "5 times too" in contradiction_of_depth(depth)


class TestDarkness:
    def test_noise_of_a_covered_lens_is_no_scaled_image(self) -> None:
        rng = np.random.default_rng(0)
        for share in (0.0, 0.01, 0.3, 1.0):
            assert not scaled_to_one((rng.random((120, 160)) < share).astype(np.uint8))


def people_named(frames: Sequence[Frame], *, swap: bool) -> str:
    detector = CheckedDetector(load_detector(Path(MODELS or "") / "yolox_nano.onnx"))
    warnings = InputWarnings()
    watch = InputChecks(clip().camera, warnings, detector)
    for frame in frames:
        detector(np.ascontiguousarray(frame.image[..., ::-1]) if swap else frame.image)
    watch.look(frames[-1])
    return "\n".join(warnings.all)


@pytest.mark.skipif(MODELS is None, reason="JAXSLAM_MODELS is not set: no networks here")
@pytest.mark.parametrize(("path", "start"), [("composite/kitchen_people", 100), ("bonn/rgbd_bonn_crowd", 330)])
def test_swapped_red_and_blue(data_dir: Path, path: str, start: int) -> None:
    dataset = open_dataset(data_dir / path, camera=COMPOSITE_CAMERA if "kitchen" in path else None)
    frames = [dataset[index] for index in range(start, start + FRAMES, 2)]
    assert people_named(frames, swap=False) == ""
    assert "image: expected RGB" in people_named(frames, swap=True)
