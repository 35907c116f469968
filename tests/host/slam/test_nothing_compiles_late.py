"""Nothing is compiled after `Slam.warm_up`, whatever frames come: a robot in motion does not wait for a compiler.

The optimization of loops is compiled for larger maps while they grow, ahead of need and in a thread of its own.
"""

import dataclasses
import functools
import threading
from pathlib import Path

import jax
import numpy as np
import pytest
from real_networks import real_network
from small_map import small_map
from small_scene import HEIGHT, SETTINGS, TRACK, WIDTH, Clip

from jaxslam.config.loading import load_config
from jaxslam.config.schema import Config, DenseConfig
from jaxslam.datasets import open_dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import between
from jaxslam.loop_closing import essential_graph
from jaxslam.map.types import Map
from jaxslam.semantics import Detections
from jaxslam.sensors.frame import Frame
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

PRESETS = sorted(file.stem for file in (Path(__file__).resolve().parents[3] / "configs" / "presets").glob("*.yaml"))
CONFIG = Config(track=dataclasses.replace(TRACK, restart_after=8))
DENSE = dataclasses.replace(CONFIG, dense=DenseConfig(enabled=True, max_points=20_000))
BLACK = Frame(0, np.zeros((HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT, WIDTH), np.float32))


@functools.cache
def room(people: int = 0) -> Clip:
    """A path whose end shows other things than its beginning."""
    config = SyntheticConfig(width=WIDTH, height=HEIGHT, frames=72, people=people, path="loop", fps=15)
    source = SyntheticDataset(config)
    return Clip(source, [source[index] for index in range(72)])


def somebody(image: np.ndarray, /) -> Detections:
    """A detector: in every image, a person stands at the left."""
    mask = np.zeros((1, *image.shape[:2]), bool)
    mask[0, 40:, 10:40] = True
    return Detections(np.array([[10, 40, 40, HEIGHT]], np.float32), np.ones(1, np.float32), ("person",), mask, None)


def order(frames: list[Frame]) -> list[Frame]:
    """Lost and relocalized; then lost where the map does not reach, and a new submap, which meets the old one."""
    flipped = [dataclasses.replace(frame, image=frame.image[::-1].copy()) for frame in frames[:16]]
    return [*frames, BLACK, BLACK, *frames[40:50], *[BLACK] * 3, *flipped, *[BLACK] * 3, *frames[40:60]]


def script(slam: Slam, frames: list[Frame], compiled: list[str]) -> list[TrackStatus]:
    """Warm up and track; the statuses."""
    slam.warm_up()
    compiled.clear()
    statuses = [
        slam.track(dataclasses.replace(frame, timestamp_ns=index * 66_666_666, depth_timestamp_ns=None)).status
        for index, frame in enumerate(frames)
    ]
    slam.finish()
    assert compiled == []
    return statuses


@pytest.mark.slow
@pytest.mark.parametrize("live", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_losses_and_submaps(compiled: list[str], *, live: bool) -> None:
    """Then a reset, and another tracker with the same settings."""
    jax.clear_caches()
    settings = dataclasses.replace(CONFIG, run=dataclasses.replace(CONFIG.run, deterministic=not live))
    with Slam(room().camera, settings) as slam:
        statuses = script(slam, order(room().frames), compiled)
        assert TrackStatus.RELOCALIZED in statuses
        assert statuses.count(TrackStatus.STARTED) == 2
        slam.reset()
        script(slam, room().frames[:10], compiled)
    compiled.clear()
    with Slam(room().camera, settings) as again:
        script(again, room().frames[:10], compiled)
    assert compiled == []


@pytest.mark.slow
def test_a_dense_map_that_is_full(compiled: list[str]) -> None:
    jax.clear_caches()
    with Slam(room().camera, DENSE) as slam:
        script(slam, order(room().frames), compiled)
        assert slam.dense is not None
        assert slam.dense_mapping is not None
        assert slam.dense_mapping.figures().coarsened > 0
        assert compiled == []


@pytest.mark.slow
@pytest.mark.parametrize("localize_only", [False, True])
def test_a_loaded_map(compiled: list[str], *, localize_only: bool) -> None:
    with Slam(room().camera, CONFIG) as slam:
        for frame in room().frames:
            slam.track(frame)
        slam.finish()
        made: Map = slam.map
    jax.clear_caches()
    with Slam(room().camera, CONFIG, slam_map=made, localize_only=localize_only) as slam:
        assert TrackStatus.RELOCALIZED in script(slam, [*room().frames[30:60], BLACK, *room().frames[10:20]], compiled)


def test_loops_of_a_loaded_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """All sizes that the submaps of a large map may have, and the next one if the map may soon outgrow them."""
    sizes: list[int] = []
    monkeypatch.setattr(essential_graph, "compile_graph", sizes.append)
    graphs = essential_graph.GraphCompiler()
    graphs.compile_now(0)
    assert sizes == [64]
    sizes.clear()
    graphs.compile_now(60)
    graphs.keep_ahead(128)
    assert sizes == [64, 256]


@pytest.mark.slow
@pytest.mark.parametrize("num_keyframes", [65, 257, 1025])
def test_loops_of_a_map_that_grows(compiled: list[str], num_keyframes: int) -> None:
    """The graph that a map outgrows its last one with is there when it does: it was begun at half of that."""
    slam_map = small_map(num_keyframes)
    loop = between(slam_map.pose(0), slam_map.pose(num_keyframes - 1))
    essential_graph.GraphCompiler().keep_ahead(num_keyframes // 2 + 1)
    for thread in threading.enumerate():
        if thread.name == essential_graph.COMPILE_THREAD:
            thread.join()
    compiled.clear()
    assert essential_graph.poses_with_loop(slam_map, 0, num_keyframes - 1, loop, np.eye(6), 6.0) is not None
    assert compiled == []


@pytest.mark.slow
def test_another_image_size(compiled: list[str]) -> None:
    """Its tracker compiles when it warms up, and no later; neither does the first one after that."""
    source = SyntheticDataset(SyntheticConfig(width=200, height=152, frames=8))
    other = Clip(source, [source[index] for index in range(8)])
    jax.clear_caches()
    with Slam(room().camera, CONFIG) as slam, Slam(other.camera, CONFIG) as wider:
        script(slam, room().frames[:8], compiled)
        script(wider, other.frames, compiled)
        slam.reset()
        script(slam, room().frames[:8], compiled)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["ngd", "default"])
def test_a_real_network(compiled: list[str], data_dir: Path, preset: str) -> None:
    """Its boxes become masks, and those are propagated: people leave and come, and the place is lost and found."""
    recording = open_dataset(data_dir / "bonn" / "rgbd_bonn_crowd")
    settings = load_config(preset=preset, overrides=[f"semantics.model={real_network('yolox_nano')}"])
    frames = [recording[index] for index in range(400, 460)]
    dark = dataclasses.replace(frames[0], image=np.zeros_like(frames[0].image))
    jax.clear_caches()
    with Slam(recording.camera, settings) as slam:
        script(slam, [*frames, dark, dark, *frames[30:40]], compiled)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_presets(compiled: list[str], preset: str) -> None:
    """Each with people, and with a detector that looks at the frames that the preset says."""
    jax.clear_caches()
    settings = load_config(preset=preset, overrides=[*SETTINGS, "semantics.model=null"])
    with Slam(room(1).camera, settings, detector=somebody) as slam:
        script(slam, order(room(1).frames), compiled)


@pytest.mark.slow
def test_stereo(compiled: list[str], data_dir: Path) -> None:
    recording = open_dataset(data_dir / "kitti/sequences/06")
    first = recording[0]
    dark = dataclasses.replace(
        first, image=np.zeros_like(first.image), right=None if first.right is None else np.zeros_like(first.right)
    )
    frames = [recording[index] for index in range(30)]
    jax.clear_caches()
    with Slam(recording.camera, load_config(overrides=["semantics.model=null"])) as slam:
        statuses = script(slam, [*frames, dark, dark, *frames[10:15]], compiled)
        assert TrackStatus.LOST in statuses
