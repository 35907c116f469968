"""Wrong arguments and frames are refused in one line that names them; the tracker goes on as if nothing had come."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raw_pairs import RawRoom
from small_scene import CONFIG, HEIGHT, WIDTH, clip

from jaxslam.errors import DatasetError, FrameError
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

HELPERS = str(Path(__file__).resolve().parents[2] / "helpers")

MAX_CHARACTERS, MAX_S = 300, 2.0
AFTER = 5
IMAGE, DEPTH_M = clip().frames[AFTER].image, clip().frames[AFTER].depth_m
NOW = clip().frames[AFTER].timestamp_ns
SECOND = 1_000_000_000
CAMERA: Any = clip().camera


@pytest.fixture(scope="module")
def slam() -> Slam:
    return Slam(CAMERA, CONFIG)


def frame(**fields: Any) -> Callable[[], Any]:
    """Makes a frame of which some fields are of another kind."""
    return lambda: Frame(**({"timestamp_ns": NOW, "image": IMAGE, "depth_m": DEPTH_M} | fields))


def depth_as(dtype: str) -> np.ndarray:
    assert DEPTH_M is not None
    return DEPTH_M.astype(dtype)


REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "None": (lambda: None, "frame: expected a jaxslam.Frame, got NoneType"),
    "an array": (lambda: IMAGE, "frame: expected a jaxslam.Frame, got ndarray"),
    "a tuple": (lambda: (NOW, IMAGE, DEPTH_M), "frame: expected a jaxslam.Frame, got tuple"),
    "a float time": (frame(timestamp_ns=1.5e9), "timestamp_ns: expected an int"),
    "no time": (frame(timestamp_ns=None), "timestamp_ns: expected an int"),
    "a time of 65 bits": (frame(timestamp_ns=2**63), "timestamp_ns: .* that fits 64 bits, got one of 65 bits"),
    "a time of many digits": (frame(timestamp_ns=-(10**5000)), "timestamp_ns: expected an int that fits 64 bits"),
    "an array of times": (frame(timestamp_ns=np.arange(5000)), "timestamp_ns: expected an int in nanoseconds, got arr"),
    "the least time": (frame(timestamp_ns=-(2**63)), "timestamp_ns: expected more than the last frame's"),
    "NumPy's least time": (frame(timestamp_ns=np.int64(-(2**63))), "timestamp_ns: expected more than the last"),
    "the time before": (frame(timestamp_ns=NOW - SECOND), "timestamp_ns: expected more than the last frame's"),
    "a float depth time": (frame(depth_timestamp_ns=0.5), "depth_timestamp_ns: expected an int"),
    "a smaller image": (frame(image=IMAGE[::2, ::2], depth_m=depth_as("f4")[::2, ::2]), "image: expected the camera's"),
    "a turned image": (
        frame(image=IMAGE.transpose(1, 0, 2), depth_m=depth_as("f4").T),
        "image: expected the camera's 160x120 pixels, got 120x160",
    ),
    "four channels": (frame(image=np.dstack([IMAGE, IMAGE[..., 0]])), "image: expected .* drop the alpha channel"),
    "two channels": (frame(image=IMAGE[..., :2]), r"image: expected .* got shape \(120, 160, 2\)"),
    "channels first": (frame(image=IMAGE.transpose(2, 0, 1)), r"image: expected .* got shape \(3, 120, 160\)"),
    "a float image": (frame(image=IMAGE / 255), "image: expected .* got float64; scale"),
    "16 bits": (frame(image=IMAGE.astype(">u2")), "image: expected .* got >u2"),
    "signed bytes": (frame(image=IMAGE.view(np.int8)), "image: expected .* got int8"),
    "a list": (frame(image=IMAGE.tolist()), "image: expected .* got list"),
    "bytes": (frame(image=IMAGE.tobytes()), "image: expected .* got bytes"),
    "no pixels": (frame(image=IMAGE[:0]), r"image: expected .* got shape \(0, 160, 3\)"),
    "objects": (frame(image=IMAGE.astype(object)), "image: expected .* got object"),
    "depth of 16 bits": (frame(depth_m=(1000 * depth_as("f4")).astype(np.uint16)), "depth_m: expected .* got uint16"),
    "depth of 64 bits": (frame(depth_m=depth_as("f8")), "depth_m: expected .* got float64"),
    "big-endian depth": (frame(depth_m=depth_as(">f4")), "depth_m: expected .* got >f4"),
    "depth of another size": (frame(depth_m=depth_as("f4")[:60]), "depth_m: expected the image's 160x120 pixels"),
    "depth in a column": (frame(depth_m=depth_as("f4")[..., None]), r"depth_m: expected .* got shape \(120, 160, 1\)"),
    "a pair": (frame(depth_m=None, right=IMAGE), "depth_m: expected depth, as the camera is no stereo pair"),
    "a mask of bytes": (frame(dynamic_mask=np.zeros((HEIGHT, WIDTH), np.uint8)), "dynamic_mask: expected .* got uint8"),
    "a mask of another size": (frame(dynamic_mask=np.zeros((9, 9), bool)), "dynamic_mask: expected the image's"),
}
"""Frames that are refused, and by what words."""


def strided(array: np.ndarray) -> np.ndarray:
    """The same numbers, with gaps between them."""
    wide = np.repeat(np.repeat(array, 2, axis=0), 3, axis=1)
    return wide[::2, ::3]


def reversed_rows(array: np.ndarray) -> np.ndarray:
    """The same numbers in a view that goes backward in memory."""
    return array[::-1].copy()[::-1]


def read_only(array: np.ndarray) -> np.ndarray:
    """The same numbers, which nobody may write to."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy


TAKEN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "column by column": np.asfortranarray,
    "strided": strided,
    "backward": reversed_rows,
    "read-only": read_only,
}
"""Layouts in memory that are as good as any."""


def begun(slam: Slam) -> None:
    slam.reset()
    for good in clip().frames[:AFTER]:
        slam.track(good)


@pytest.fixture(scope="module")
def undisturbed(slam: Slam) -> FrameResult:
    begun(slam)
    return slam.track(frame()())


def assert_same(tracked: FrameResult, undisturbed: FrameResult) -> None:
    assert tracked.status is TrackStatus.OK
    np.testing.assert_array_equal(tracked.T_world_cam, undisturbed.T_world_cam)


def test_thirty_frames() -> None:
    assert len(REFUSED) >= 30


@pytest.mark.parametrize("kind", REFUSED)
def test_frame_is_refused_and_forgotten(slam: Slam, undisturbed: FrameResult, kind: str) -> None:
    make, words = REFUSED[kind]
    begun(slam)
    began = time.monotonic()
    with pytest.raises(FrameError, match=words) as error:
        slam.track(make())
    assert time.monotonic() - began < MAX_S
    assert "\n" not in str(error.value)
    assert len(str(error.value)) <= MAX_CHARACTERS
    assert_same(slam.track(frame()()), undisturbed)


@pytest.mark.parametrize("layout", TAKEN)
def test_any_layout_gives_the_same_pose(slam: Slam, undisturbed: FrameResult, layout: str) -> None:
    begun(slam)
    fields = {"image": TAKEN[layout](IMAGE), "depth_m": TAKEN[layout](depth_as("f4"))}
    assert_same(slam.track(frame(**fields)()), undisturbed)


def test_times_of_numpy_do_not_overflow(slam: Slam) -> None:
    """From the least to the greatest time in 64 bits: 584 years, after which nothing is where it was believed."""
    slam.reset()
    slam.track(frame(timestamp_ns=np.int64(-(2**63)))())
    result = slam.track(frame(timestamp_ns=np.int64(2**63 - 1))())
    assert np.isfinite(result.T_world_cam).all()
    assert result.twist == pytest.approx(np.zeros(6), abs=1e-6)


class TestConstructor:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (("bonn",), "camera: expected a jaxslam.Camera, got str; Camera.load takes a name or a file"),
            ((None,), "camera: expected a jaxslam.Camera, got NoneType"),
            ((CAMERA, "ngd"), r"config: expected a jaxslam.Config, got str; load_config\('ngd'\)"),
            ((CAMERA, {"run": {}}), r"config: expected a jaxslam.Config, got dict; load_config\(overrides="),
        ],
        ids=["name", "nothing", "preset", "dict"],
    )
    def test_wrong_type(self, arguments: tuple[Any, ...], words: str) -> None:
        with pytest.raises(TypeError, match=words):
            Slam(*arguments)

    @pytest.mark.parametrize(
        ("keyword", "value", "words"),
        [
            ("slam_map", "room.npz", r"slam_map: expected a jaxslam.Map, got str; Slam.load\(path\)"),
            ("detector", 3, "detector: expected a callable that takes an image, got int"),
            ("key_detector", "person", "key_detector: expected a callable that takes an image, got str"),
        ],
    )
    def test_wrong_keyword(self, keyword: str, value: Any, words: str) -> None:
        with pytest.raises(TypeError, match=words):
            Slam(CAMERA, CONFIG, **{keyword: value})

    def test_pair(self) -> None:
        pair: Any = RectifiedPair(RawRoom(frames=1).rig)
        with pytest.raises(TypeError, match=r"camera: expected a jaxslam.Camera, got RectifiedPair; give its .camera"):
            Slam(pair)


class TestRun:
    @pytest.mark.parametrize(
        ("dataset", "words"),
        [
            ((frame for frame in clip().frames), "got generator without camera, timestamps_ns, __len__, __getitem__"),
            (clip().frames, r"got list without camera, timestamps_ns; give single frames to Slam.track"),
        ],
        ids=["generator", "list"],
    )
    def test_no_recording(self, slam: Slam, dataset: Any, words: str) -> None:
        with pytest.raises(DatasetError, match=words):
            slam.run(dataset)

    def test_recording_that_gives_no_frame(self, slam: Slam) -> None:
        """It is rejected for what it is, not dropped as if it had come late."""
        recording: Any = clip(frames=60)
        recording.frames, recording.timestamps_ns = recording.frames[:4], recording.timestamps_ns[:4]
        recording.frames[2] = None
        results: list[FrameResult | Rejected] = []
        slam.reset()
        slam.run(recording, lambda _, result: results.append(result))
        rejected = results[2]
        assert isinstance(rejected, Rejected)
        assert rejected.status is TrackStatus.REJECTED
        assert str(rejected.reason) == "frame 2: expected a jaxslam.Frame, got NoneType"
        assert results[3].status is TrackStatus.OK


def test_threads_wait_for_each_other(slam: Slam) -> None:
    """Frames from two threads: each is tracked or, where a later one came first, refused; nothing else goes wrong."""
    slam.reset()
    results: list[FrameResult] = []
    errors: list[Exception] = []

    def feed(frames: list[Frame]) -> None:
        for one in frames:
            try:
                results.append(slam.track(one))
            except Exception as error:  # to be looked at by the test
                errors.append(error)

    frames = clip().frames[:20]
    threads = [threading.Thread(target=feed, args=(frames[start::2],)) for start in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) + len(errors) == len(frames)
    assert len(results) > len(frames) // 2 - 1
    assert {type(error) for error in errors} <= {FrameError}
    assert slam.track(clip().frames[20]).status is TrackStatus.OK


OTHER_PROCESS = """
import multiprocessing, os, sys, warnings
warnings.simplefilter("ignore")
import jax
from small_scene import CONFIG, clip
from jaxslam.slam import Slam

def work(slam, queue):
    try:
        slam = slam or Slam(clip().camera, CONFIG)
        queue.put(slam.track(clip().frames[0]).status.name)
    except RuntimeError as error:
        queue.put(str(error))

if __name__ == "__main__":
    jax.numpy.zeros(1).block_until_ready()
    parents = Slam(clip().camera, CONFIG)
    for method, slam in (("fork", None), ("fork", parents), ("spawn", None)):
        context = multiprocessing.get_context(method)
        queue = context.Queue()
        process = context.Process(target=work, args=(slam, queue))
        process.start()
        print(method, queue.get(timeout=200), flush=True)
        process.join()
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_other_processes(tmp_path: Path) -> None:
    """A forked process is told so instead of hanging; a spawned one tracks."""
    script = tmp_path / "processes.py"
    script.write_text(f"import sys; sys.path.insert(0, {HELPERS!r})\n{OTHER_PROCESS}")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=300, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 3
    for line in lines[:2]:
        assert line.startswith("fork jaxslam cannot compute in a process that was forked")
        assert "multiprocessing.get_context('spawn')" in line
    assert lines[2] == "spawn STARTED"
