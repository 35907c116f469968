"""Recordings for the viewer: what is written is read back with rerun's own reader and compared with the run."""

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from command_line import failing
from PIL import Image
from rerun.chunk import RrdReader
from small_scene import CONFIG, HEIGHT, WIDTH, clip
from tiny_recording import CAMERA, write_recording

import jaxslam.visualization.rerun_viewer
from jaxslam.errors import JaxSlamError
from jaxslam.map.types import Map
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.mask_pipeline import MaskSource
from jaxslam.slam.slam import Slam
from jaxslam.trajectory.trajectory import Trajectory
from jaxslam.visualization.rerun_viewer import Viewer

fails = failing("run", "walk")

FRAMES = 12
MASKED = range(4, 7)
REJECTED = 9
IMAGE = "/world/camera/image"
LOGGED_EVERY_FRAME = [
    *("/world/camera", f"{IMAGE}/rgb", f"{IMAGE}/depth", f"{IMAGE}/points"),
    *("/tracking/track_ms", "/tracking/inliers", "/mask/ratio", "/mask/age"),
]


class Run(NamedTuple):
    frames: list[Frame]
    results: list[FrameResult | Rejected]
    map: Map
    trajectory: Trajectory
    rows: dict[str, list[dict[str, Any]]]
    blueprints: int

    def at(self, entity: str, frame: int) -> dict[str, Any]:
        (row,) = [row for row in self.rows[entity] if row.get("frame") == frame]
        return row

    def tracked(self, frame: int) -> FrameResult:
        result = self.results[frame]
        assert isinstance(result, FrameResult)
        return result


def read(path: Path) -> tuple[dict[str, list[dict[str, Any]]], int]:
    """The rows of every entity, in the order of the frames, and the number of blueprints."""
    reader, rows = RrdReader(path), {}
    for chunk in reader.stream().to_chunks():
        rows.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    for entity in rows.values():
        entity.sort(key=lambda row: row.get("frame", -1))
    return rows, len(reader.blueprints())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    recording, path = clip(), tmp_path_factory.mktemp("viewer") / "run.rrd"
    frames = recording.frames[:FRAMES]
    recording.frames, recording.timestamps_ns = frames, recording.timestamps_ns[:FRAMES]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20:90, 10:60] = True
    for index in MASKED:
        frames[index] = Frame(frames[index].timestamp_ns, frames[index].image, frames[index].depth_m, mask)
    small = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)
    frames[REJECTED] = Frame(frames[REJECTED].timestamp_ns, small.astype(np.uint8), small)
    results: list[FrameResult | Rejected] = []
    with Slam(recording.camera, CONFIG) as slam, Viewer(slam, recording.ground_truth, path=path) as viewer:
        slam.run(recording, lambda frame, result: (viewer(frame, result), results.append(result))[0])
    return Run(frames, results, slam.map, slam.trajectory, *read(path))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = write_recording(tmp_path / "walk")
    CAMERA.save(folder / "camera.yaml")
    return folder


def test_entities(run: Run) -> None:
    world = {"/world", "/world/trajectory", "/world/trajectory/final", "/world/truth"}
    world |= {"/world/map/points", "/world/map/keyframes", IMAGE, f"{IMAGE}/mask"}
    assert set(run.rows) == {*LOGGED_EVERY_FRAME, *world, "/tracking/status", "/__properties"}
    assert run.blueprints == 1


@pytest.mark.parametrize("entity", LOGGED_EVERY_FRAME)
def test_every_frame_has_a_row(run: Run, entity: str) -> None:
    rows = [row for row in run.rows[entity] if "frame" in row]
    expected = [index for index in range(FRAMES) if index != REJECTED]
    assert [row["frame"] for row in rows] == expected
    assert [row["time"].value for row in rows] == [run.frames[index].timestamp_ns for index in expected]


def test_mask(run: Run) -> None:
    """While there is one, and once without any."""
    shown = [row for row in run.rows[f"{IMAGE}/mask"] if "frame" in row]
    assert [row["frame"] for row in shown] == [*MASKED, MASKED[-1] + 1]
    for row in shown:
        (size,), (pixels,) = row["SegmentationImage:format"], row["SegmentationImage:buffer"]
        assert (size["width"], size["height"]) == (WIDTH, HEIGHT)
        classes = np.array(pixels, np.uint8).reshape(HEIGHT, WIDTH)
        mask = run.tracked(row["frame"]).dynamic_mask
        assert mask.any() == (row["frame"] in MASKED)
        np.testing.assert_array_equal(classes, mask * np.uint8(MaskSource.CALLER))


def test_every_source_of_a_mask_has_a_name(run: Run) -> None:
    (context,) = [row["AnnotationContext:context"][0] for row in run.rows[f"{IMAGE}/mask"] if "frame" not in row]
    labels = {each["class_id"]: each["class_description"]["info"]["label"] for each in context}
    assert labels == {0: "nothing"} | {source: source.name.lower() for source in list(MaskSource)[1:]}


def test_pose(run: Run) -> None:
    for index in (0, 5, FRAMES - 1):
        row, expected = run.at("/world/camera", index), run.tracked(index).T_world_cam
        np.testing.assert_allclose(row["Transform3D:translation"][0], expected[4:], atol=1e-6)
        np.testing.assert_allclose(row["Transform3D:quaternion"][0], expected[[1, 2, 3, 0]], atol=1e-6)


def test_images(run: Run) -> None:
    frame = run.frames[3]
    (jpeg,), (png,) = (
        run.at(f"{IMAGE}/rgb", 3)["EncodedImage:blob"],
        run.at(f"{IMAGE}/depth", 3)["EncodedDepthImage:blob"],
    )
    with Image.open(io.BytesIO(bytes(jpeg))) as picture:
        assert np.abs(np.asarray(picture).astype(float) - frame.image).mean() < 5
    with Image.open(io.BytesIO(bytes(png))) as picture:
        depth = np.asarray(picture)
    assert (depth.shape, depth.dtype) == ((HEIGHT, WIDTH), np.uint16)
    assert frame.depth_m is not None
    np.testing.assert_allclose(depth[::2, ::2] / 1000, np.nan_to_num(frame.depth_m[::2, ::2]), atol=5.1e-4)
    np.testing.assert_array_equal(depth[1::2, 1::2], depth[::2, ::2])
    assert len(jpeg) + len(png) < 2 * HEIGHT * WIDTH


def test_points_and_camera(run: Run) -> None:
    """rerun counts pixels from the corner of the image."""
    tracked, camera = run.tracked(6), clip().camera
    alive = tracked.weights > 0
    row = run.at(f"{IMAGE}/points", 6)
    np.testing.assert_allclose(row["Points2D:positions"], tracked.uv.T[alive] + 0.5, atol=1e-4)
    new = np.array(row["Points2D:colors"], np.uint32) == 0xFFA500FF
    np.testing.assert_array_equal(new, ~tracked.followed[alive])
    assert tracked.followed.any()
    columns = np.reshape(run.rows[IMAGE][0]["Pinhole:image_from_camera"][0], (3, 3))
    expected = [[camera.fx, 0, 0], [0, camera.fy, 0], [camera.cx + 0.5, camera.cy + 0.5, 1]]
    np.testing.assert_allclose(columns, expected, rtol=1e-6)


def test_figures_and_words(run: Run) -> None:
    assert run.at("/tracking/inliers", 3)["Scalars:scalars"] == [run.tracked(3).num_inliers]
    assert run.at("/mask/ratio", 5)["Scalars:scalars"] == [pytest.approx(run.tracked(5).dynamic_ratio)]
    words = {row["frame"]: (row["TextLog:level"][0], row["TextLog:text"][0]) for row in run.rows["/tracking/status"]}
    assert words[0][0] == "INFO"
    assert words[0][1].startswith("STARTED")
    assert words[1] == ("INFO", "OK")
    assert words[REJECTED] == ("ERROR", f"REJECTED: {run.results[REJECTED].reason}")
    assert set(words) == {0, 1, REJECTED, REJECTED + 1}


def test_map_and_paths_in_the_end(run: Run) -> None:
    points, keyframes = run.rows["/world/map/points"][-1], run.rows["/world/map/keyframes"][-1]
    np.testing.assert_allclose(points["Points3D:positions"], run.map.points.X_world.T, atol=1e-5)
    np.testing.assert_allclose(keyframes["Points3D:positions"], run.map.T_world_cam[:, 4:], atol=1e-5)
    assert len(run.map.points.ids) > 50
    (final,) = run.rows["/world/trajectory/final"][0]["LineStrips3D:strips"]
    np.testing.assert_allclose(final, run.trajectory.positions, atol=1e-5)
    online = np.array([row["LineStrips3D:strips"][0] for row in run.rows["/world/trajectory"]])
    np.testing.assert_array_equal(online[1:, 0], online[:-1, 1])
    np.testing.assert_allclose(online[-1, 1], run.tracked(FRAMES - 1).T_world_cam[4:], atol=1e-6)
    (truth,) = run.rows["/world/truth"][0]["LineStrips3D:strips"]
    assert len(truth) == FRAMES
    np.testing.assert_allclose(np.delete(truth, REJECTED, axis=0), run.trajectory.positions, atol=0.01)


def test_map_that_stays_is_written_once(run: Run) -> None:
    frames = [row["frame"] for row in run.rows["/world/map/points"]]
    assert frames == sorted(set(frames))
    assert len(frames) <= 2


class TestErrors:
    @pytest.fixture(autouse=True)
    def _nothing_is_tracked(self, monkeypatch: pytest.MonkeyPatch, recording: Path) -> Iterator[None]:
        monkeypatch.chdir(recording.parent)
        yield
        assert not (recording.parent / "results").exists()

    def test_file_that_cannot_be_written(self, capsys: pytest.CaptureFixture[str]) -> None:
        expected = "nowhere/run.rrd: cannot be written: "
        assert fails(capsys, "--rrd", "nowhere/run.rrd").startswith(expected)

    def test_rerun_is_not_installed(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "rerun", None)
        monkeypatch.delitem(sys.modules, "jaxslam.visualization.rerun_viewer")
        line = fails(capsys, "--rrd", "run.rrd")
        assert line.startswith("rerun cannot be imported")
        assert "pip install 'jaxslam[viz]'" in line

    @pytest.mark.skipif(sys.platform != "linux", reason="only there the environment says whether there is a screen")
    def test_no_screen(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(name, raising=False)
        assert "needs a screen" in fails(capsys, "--viz")

    def test_no_viewer(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        def spawn(**_: object) -> None:
            raise RuntimeError("Failed to find Rerun Viewer executable in PATH.\n\nYou can ...")

        monkeypatch.setenv("DISPLAY", ":0")
        monkeypatch.setattr(jaxslam.visualization.rerun_viewer.rr, "spawn", spawn)
        expected = "the viewer cannot be started: Failed to find Rerun Viewer executable in PATH."
        assert fails(capsys, "--viz") == expected

    def test_neither_file_nor_viewer(self) -> None:
        with pytest.raises(JaxSlamError, match="expected a file to write or a live viewer, got neither"):
            Viewer(Slam(clip().camera, CONFIG))
