"""`track_clips` and `jaxslam bench batch`: clips at once are what each is alone, and figures are what they say."""

import contextlib
import inspect
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import failing
from PIL import Image
from quick_compile import quick_compile
from small_scene import HEIGHT, TRACK, WIDTH

import jaxslam.tracking.batch as track_batch
from jaxslam.benchmark import batch_throughput as batch
from jaxslam.benchmark.batch_throughput import Task, Way, make_task, measure, ways
from jaxslam.benchmark.reports.batch import COLUMNS, cells, markdown_report, picture
from jaxslam.cli.entry_point import main
from jaxslam.errors import ConfigError, FrameError
from jaxslam.tracking.batch import TrackedClips, track_clips
from jaxslam.tracking.state import TrackParams, TrackStatus
from jaxslam.tracking.step import track_step

fails = failing("bench", "batch")

FRAMES, SAME_M = 4, 1e-4
FILES = {"batch.json", "batch.md", "batch.png"}
PRINTED = "printed.json"


@pytest.fixture(scope="module", autouse=True)
def small_programs() -> Iterator[None]:
    """Compiling is what these tests cost; all of them use the programs that the command makes, of two clips and one."""
    together = quick_compile(inspect.unwrap(track_batch._step), static_argnames="plan")
    by_itself = quick_compile(track_step, static_argnames="plan")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(track_batch, "_step", together)
        patch.setattr(batch, "_step_alone", by_itself)
        patch.setattr(batch, "_settings", lambda width: TRACK)
        yield


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command leaves behind; what it prints is in a file beside this folder."""
    folder = tmp_path_factory.mktemp("batch") / "out"
    size, options = f"{WIDTH}x{HEIGHT}", ["--clips", "2", "--frames", str(FRAMES), "--out", str(folder), "--json"]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        main(["bench", "batch", "--size", size, *options])
    (folder.parent / PRINTED).write_text(printed.getvalue())
    return folder


@pytest.fixture(scope="module")
def content(out: Path) -> dict[str, Any]:
    return json.loads((out / "batch.json").read_text())


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task(3, FRAMES, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def alone(out: Path, task: Task) -> TrackedClips:
    """Each clip by itself, with the same step."""
    return batch.loop([room.frames for room in task.rooms], task)


def changed(params: TrackParams, **changes: float) -> TrackParams:
    return params._replace(**{name: jnp.float32(value) for name, value in changes.items()})


class TestTrackClips:
    @pytest.mark.slow
    @pytest.mark.parametrize("threads", [1, 2])
    def test_vmap_equals_loop(self, task: Task, alone: TrackedClips, threads: int) -> None:
        """Three clips in two programs: the last one is filled up."""
        clips = [room.frames for room in task.rooms]
        found = track_clips(clips, task.params, task.plan, at_once=2, threads=threads)
        assert found.T_world_cam.shape == (3, FRAMES, 7)
        assert found.status.tolist() == [[TrackStatus.STARTED] + [TrackStatus.OK] * (FRAMES - 1)] * 3
        np.testing.assert_array_equal(found.status, alone.status)
        np.testing.assert_allclose(found.T_world_cam, alone.T_world_cam, atol=SAME_M)
        assert (np.linalg.norm(found.T_world_cam[1:, -1, 4:] - found.T_world_cam[0, -1, 4:], axis=1) > 1e-3).all()

    @pytest.mark.slow
    def test_settings_of_each(self, task: Task, alone: TrackedClips) -> None:
        """One clip twice: as it is, and with more inliers asked for than there are points."""
        clip = task.rooms[0].frames
        found = track_clips([clip, clip], [task.params, changed(task.params, min_inliers=1e4)], task.plan)
        np.testing.assert_allclose(found.T_world_cam[0], alone.T_world_cam[0], atol=SAME_M)
        assert found.status.tolist() == [alone.status[0].tolist(), [TrackStatus.LOST] * FRAMES]

    @pytest.mark.slow
    def test_seeds_of_each(self, task: Task, alone: TrackedClips) -> None:
        """Pose hypotheses are drawn anew, and the poses are as good."""
        clip = task.rooms[0].frames
        found = track_clips([clip, clip], task.params, task.plan, seeds=[0, 7])
        np.testing.assert_allclose(found.T_world_cam[0], alone.T_world_cam[0], atol=SAME_M)
        off = np.linalg.norm(found.T_world_cam[1, :, 4:] - found.T_world_cam[0, :, 4:], axis=1)
        assert 0 < off.max() < 0.02

    @pytest.mark.slow
    def test_same_bytes_again(self, task: Task, alone: TrackedClips) -> None:
        clips = [room.frames for room in task.rooms[:2]]
        first, second = (track_clips(clips, task.params, task.plan) for _ in range(2))
        np.testing.assert_array_equal(first.T_world_cam, second.T_world_cam)

    def test_bad_input(self, task: Task) -> None:
        clip, params = task.rooms[0].frames, task.params
        with pytest.raises(FrameError, match="clips: expected at least one, got none"):
            track_clips([], params)
        with pytest.raises(FrameError, match=r"clips: expected images \(frames, h, w\).*got \(120, 160\)"):
            track_clips([jax.tree.map(lambda array: array[0], clip)], params)
        shorter = jax.tree.map(lambda array: array[:-1], clip)
        with pytest.raises(FrameError, match=r"image: expected uint8 \(4, 120, 160\).*got uint8 \(3, 120, 160\) in cl"):
            track_clips([clip, shorter], params)
        with pytest.raises(FrameError, match=r"depth: expected float32.*got float64 \(4, 120, 160\) in clip 1"):
            track_clips([clip, clip._replace(depth=clip.depth.astype(np.float64))], params)
        with pytest.raises(ConfigError, match="params: expected one for each of 2 clips, got 1"):
            track_clips([clip, clip], [params])
        with pytest.raises(ConfigError, match="seeds: expected one for each of 1 clips, got 2"):
            track_clips([clip], params, seeds=[1, 2])
        with pytest.raises(ConfigError, match="at_once: expected at least 1, got 0"):
            track_clips([clip], params, at_once=0)
        with pytest.raises(ConfigError, match="threads: expected at least 1, got 0"):
            track_clips([clip], params, threads=0)


@pytest.mark.slow
class TestCommand:
    def test_prints_its_figures_alone(self, out: Path, content: dict[str, Any]) -> None:
        assert json.loads((out.parent / PRINTED).read_text()) == content

    def test_figures(self, content: dict[str, Any]) -> None:
        assert content["size"] == [WIDTH, HEIGHT]
        assert (content["frames"], content["rounds"], content["different"]) == (FRAMES, 3, 2)
        assert {"cpu", "cores", "threads", "versions", "commit", "device", "backend"} <= set(content)
        (row,) = [row for row in content["rows"] if row["threads"] == 1]
        assert (row["clips"], row["way"], row["at_once"]) == (2, "one program", 2)
        assert row["ratio_to_loop"] == pytest.approx(row["frames_per_s"] / row["loop_frames_per_s"])
        assert row["frames_per_s_per_core"] == pytest.approx(row["frames_per_s"] / row["cores"])
        assert 0 < row["cores"] <= 1.1 * content["cores"]
        assert row["compile_s"] > 1 / row["frames_per_s"]
        assert row["peak_rss_mb"] > 100

    def test_vmap_equals_loop(self, content: dict[str, Any]) -> None:
        for row in content["rows"]:
            assert row["same_statuses"]
            assert row["off_alone_m"] < SAME_M
            assert row["ate_rmse_m"] == pytest.approx(np.median(row["ate_rmse_m_of_clips"]))
            assert row["ate_rmse_m"] == pytest.approx(row["ate_rmse_m_alone"], abs=SAME_M)
            assert 0 < row["ate_rmse_m"] < 0.02
            assert row["tracked_percent"] == 100

    def test_report(self, out: Path, content: dict[str, Any]) -> None:
        assert {path.name for path in out.iterdir()} == FILES
        text = (out / "batch.md").read_text()
        assert text == markdown_report(content)
        head, _, *rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
        assert tuple(head) == COLUMNS
        assert rows == [cells(row) for row in content["rows"]]
        assert "2 rendered rooms, different in motion, textures and people. " in text

    def test_picture(self, out: Path, content: dict[str, Any]) -> None:
        with Image.open(out / "batch.png") as drawn:
            assert min(drawn.size) > 400
        more = [row | {"clips": 2 * row["clips"]} for row in content["rows"]]
        other = picture(content | {"rows": content["rows"] + more})
        with Image.open(io.BytesIO(other)) as drawn:
            assert min(drawn.size) > 400
        assert other != (out / "batch.png").read_bytes()


class TestErrors:
    @pytest.mark.parametrize(
        ("arguments", "complaint"),
        [
            (("--clips", "0"), "--clips: expected numbers of at least 1, got 0"),
            (("--clips", "4", "-1"), "--clips: expected numbers of at least 1, got 4 -1"),
            (("--frames", "1"), "--frames: expected at least 3, to align them with the ground truth, got 1"),
            (("--rounds", "0"), "--rounds: expected at least 1, got 0"),
            (("--size", "320"), "--size: expected WIDTHxHEIGHT of 64 to 8192 pixels each, got '320'"),
            (("--size", "32x240"), "--size: expected WIDTHxHEIGHT of 64 to 8192 pixels each, got '32x240'"),
        ],
    )
    def test_bad_option(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: tuple[str, ...], complaint: str
    ) -> None:
        assert fails(capsys, *arguments, "--out", str(tmp_path / "out")) == f"{complaint}"
        assert not (tmp_path / "out").exists()

    def test_unwritable(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        taken = tmp_path / "taken"
        taken.write_text("a file")
        assert f"--out: '{taken}' cannot be written to" in fails(capsys, "--out", str(taken))


class TestMeasure:
    def test_ways(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Programs share the cores of a processor where there are clips enough for two on each."""
        monkeypatch.setattr(batch, "threads", lambda: 2)
        assert [ways(count) for count in (1, 3, 4, 16)] == [
            [Way(1, 1)], [Way(3, 1)], [Way(4, 1), Way(2, 2)], [Way(16, 1), Way(4, 2)]
        ]  # fmt: skip
        monkeypatch.setattr(batch, "threads", lambda: 1)
        assert ways(16) == [Way(16, 1)]
        monkeypatch.setattr(batch, "threads", lambda: 2)
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        assert ways(16) == [Way(16, 1)]

    @pytest.mark.slow
    def test_difference_is_seen(self, task: Task, alone: TrackedClips, monkeypatch: pytest.MonkeyPatch) -> None:
        """A loop that is 1 cm and a status off."""
        moved = TrackedClips(alone.T_world_cam + np.eye(7)[6] * 0.01, np.full_like(alone.status, TrackStatus.WEAK))
        monkeypatch.setattr(batch, "loop", lambda clips, task: TrackedClips(*(array[:2] for array in moved)))
        (row,) = [row for row in measure(task, 2, 1) if row["threads"] == 1]
        assert row["off_alone_m"] == pytest.approx(0.01, abs=SAME_M)
        assert not row["same_statuses"]
        assert cells(row)[-1].endswith("other statuses")
