"""The files of a run: on the small scene, and on real recordings through the command line."""

import csv
import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.tools import file_interface
from PIL import Image
from result_files import ALWAYS, FILES, MASK_FILES
from small_scene import CONFIG, clip

from jaxslam.cli.entry_point import main
from jaxslam.config.loading import load_config
from jaxslam.errors import TrajectoryError
from jaxslam.results.dense_results import DENSE_FILES
from jaxslam.results.frame_table import read_errors, read_track_ms
from jaxslam.results.run_results import RESULT_FILES, RunInfo, write_results
from jaxslam.slam.relative_pose_log import RelativePoseLog
from jaxslam.slam.slam import Slam
from jaxslam.trajectory.trajectory import Trajectory, read_tum
from jaxslam.visualization.snapshots import RunPictures

MODELS = os.environ.get("JAXSLAM_MODELS")  # before it is hidden from tests
PROMISED = {
    *("frames", "tracked", "tracked_percent", "ate_rmse_m", "ate_sim3_rmse_m", "rpe_trans_m_per_s"),
    *("rpe_rot_deg_per_s", "track_ms", "compile_s", "wall_s", "peak_rss_mb", "preset", "deterministic", "versions"),
    *("cpu", "threads", "commit"),
}


def check_summary(summary: dict[str, Any]) -> None:
    assert set(summary) >= PROMISED
    assert set(summary["track_ms"]) == {"mean", "median", "p95", "max"}
    times = summary["track_ms"]
    assert 0 < times["median"] <= times["p95"] <= times["max"]
    assert summary["tracked_percent"] == pytest.approx(100 * summary["tracked"] / summary["frames"], abs=1e-3)
    assert summary["deterministic"] is True
    assert {"python", "jaxslam", "jax", "jaxlib", "numpy"} <= set(summary["versions"])
    assert summary["peak_rss_mb"] > 100
    assert summary["wall_s"] > 0
    assert summary["threads"] >= 1
    assert summary["cpu"]


def masked(pictures: RunPictures) -> Any:
    """Shows them frames in which something is left out."""

    def show(frame: Any, result: Any) -> None:
        pictures(frame, replace(result, dynamic_mask=np.ones_like(result.dynamic_mask)))

    return show


def both(first: Any, second: Any) -> Any:
    """Shows frames to two watchers."""

    def show(frame: Any, result: Any) -> None:
        first(frame, result)
        second(frame, result)

    return show


def check_against_evo(path: Path) -> Trajectory:
    """What evo reads is what was written: positions, `xyzw` quaternions and seconds."""
    ours, theirs = read_tum(path), file_interface.read_tum_trajectory_file(path)
    np.testing.assert_allclose(theirs.positions_xyz, ours.T_world_cam[:, 4:], atol=1e-9)
    np.testing.assert_allclose(theirs.orientations_quat_wxyz, ours.T_world_cam[:, :4], atol=1e-6)
    np.testing.assert_allclose(theirs.timestamps, ours.timestamps_ns * 1e-9, rtol=0, atol=1e-6)
    return ours


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a run that loses ten frames."""
    recording, folder = clip(), tmp_path_factory.mktemp("dark")
    for index in range(30, 40):
        dark = np.zeros_like(recording[index].image)
        recording.frames[index] = replace(recording[index], image=dark)
    slam, pictures = Slam(recording.camera, CONFIG), RunPictures(len(recording))
    records = slam.run(recording, pictures)
    assert [picture.title for picture in pictures.losses] == [f"frame 30: LOST, {records[30].reason}"]
    write_results(folder, slam, records, RunInfo(recording, "default", 1.5), pictures)
    return folder


class TestTables:
    def test_a_row_a_frame(self, out: Path) -> None:
        rows = list(csv.DictReader((out / "frames.csv").read_text().splitlines()))
        assert [row["status"] for row in rows[28:42]] == ["OK"] * 2 + ["LOST"] * 10 + ["OK"] * 2
        assert all(row["reason"] for row in rows[30:40])
        np.testing.assert_allclose(read_track_ms(out / "frames.csv"), [float(row["track_ms"]) for row in rows])
        assert [float(row["timestamp_s"]) for row in rows] == sorted(float(row["timestamp_s"]) for row in rows)

    def test_why_frames_became_keyframes(self, out: Path) -> None:
        rows = list(csv.DictReader((out / "frames.csv").read_text().splitlines()))
        reasons = Counter(row["keyframe"] for row in rows)
        del reasons["NONE"]
        summary = json.loads((out / "summary.json").read_text())
        assert summary["keyframe_reasons"] == reasons
        assert reasons["STARTED"] == 1
        assert sum(reasons.values()) == summary["keyframes_made"]

    def test_earlier_names_are_read(self, out: Path, tmp_path: Path) -> None:
        """A table written before `num_keyframe_matches`, `keyframe` and `RELOCALIZED` had these names."""
        text = (out / "frames.csv").read_text()
        earlier = text.replace("num_keyframe_matches", "num_looked_up", 1).replace(",LOST,", ",RELOCALISED,", 1)
        earlier = earlier.replace(",keyframe,", ",is_keyframe,", 1)
        assert earlier.count("num_looked_up") == earlier.count("RELOCALISED") == earlier.count("is_keyframe") == 1
        (tmp_path / "frames.csv").write_text(earlier)
        np.testing.assert_array_equal(read_track_ms(tmp_path / "frames.csv"), read_track_ms(out / "frames.csv"))

    def test_errors(self, out: Path) -> None:
        errors, poses = read_errors(out / "errors.csv"), read_tum(out / "trajectory.txt")
        np.testing.assert_array_equal(errors.timestamps_ns, poses.timestamps_ns)
        distances = np.linalg.norm(errors.positions_m - errors.reference_m, axis=1)
        np.testing.assert_allclose(errors.errors_m, distances, atol=1e-8)
        summary = json.loads((out / "summary.json").read_text())
        assert np.sqrt(np.mean(np.square(errors.errors_m))) == pytest.approx(summary["ate_rmse_m"], abs=1e-8)

    def test_coverage_is_of_the_frames(self, out: Path) -> None:
        """Ten of them are black, and that they are a sixth of the time does not depend on how poses are spaced."""
        evaluation = json.loads((out / "summary.json").read_text())["evaluation"]
        assert evaluation["num_frames"] == 60
        assert evaluation["coverage_percent"] == pytest.approx(100 * 50 / 60)

    def test_stages_fill_the_frame(self, out: Path) -> None:
        """Those of the tracking thread, together, are the time of a frame."""
        summary = json.loads((out / "summary.json").read_text())
        stages = ("take over", "flow", "wait for mask", "pose", "match with map", "hand over")
        together = sum(summary["stage_ms"][stage]["mean"] for stage in stages)
        assert together == pytest.approx(summary["track_ms"]["mean"], rel=0.05)
        assert {"masks", "mapping", "places"} <= set(summary["stage_ms"])

    @pytest.mark.parametrize("text", ["", "a,b\n1,2\n", None])
    def test_other_files(self, tmp_path: Path, text: str | None) -> None:
        path = tmp_path / "table.csv"
        if text is not None:
            path.write_text(text)
        for read in (read_errors, read_track_ms):
            with pytest.raises(TrajectoryError, match=r"table\.csv: "):
                read(path)


class TestSmallScene:
    def test_files_and_summary(self, tmp_path: Path) -> None:
        recording, slam = clip(), Slam(clip().camera, CONFIG)
        pictures, poses = RunPictures(len(recording)), RelativePoseLog()
        records = slam.run(recording, both(pictures, poses))
        info = RunInfo(recording, "default", 1.5)
        summary, evaluation = write_results(tmp_path / "out", slam, records, info, pictures, poses.poses())
        assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
        assert json.loads((tmp_path / "out/summary.json").read_text()) == summary
        check_summary(summary)
        assert evaluation is not None
        assert summary["ate_rmse_m"] == evaluation.ate_rmse_m
        assert summary["consistency"]["num_poses"] == 59
        assert 0 < summary["consistency"]["nees"] < 10
        assert (summary["frames"], summary["tracked"], summary["first_loss_s"]) == (60, 60, None)
        assert len(pictures.snapshots) == 4
        assert pictures.losses == []
        assert load_config(file=tmp_path / "out/config.yaml") == CONFIG
        written = check_against_evo(tmp_path / "out/trajectory.txt")
        np.testing.assert_array_equal(written.timestamps_ns, slam.trajectory.timestamps_ns)
        np.testing.assert_allclose(written.T_world_cam, slam.trajectory.T_world_cam, atol=1e-8)

    @pytest.mark.slow
    def test_masks_of_this_run_only(self, tmp_path: Path) -> None:
        """Their pictures are there if there were masks, and go with the next run that has none."""
        recording, slam = clip(), Slam(clip().camera, CONFIG)
        pictures, poses = RunPictures(len(recording)), RelativePoseLog()
        records, info = slam.run(recording, both(masked(pictures), poses)), RunInfo(recording, "default", 1.5)
        write_results(tmp_path, slam, records, info, pictures, poses.poses())
        assert {path.name for path in tmp_path.iterdir()} == FILES | MASK_FILES == set(RESULT_FILES) - set(DENSE_FILES)
        write_results(tmp_path, slam, records, info)
        assert {path.name for path in tmp_path.iterdir()} == FILES - {"consistency.png"}
        wrong = poses.poses()._replace(covariance=np.zeros_like(poses.poses().covariance))
        summary, _ = write_results(tmp_path, slam, records, info, poses=wrong)
        assert summary["consistency"] is None
        assert summary["consistency_problem"].startswith("covariance: expected positive definite")
        assert {path.name for path in tmp_path.iterdir()} == FILES - {"consistency.png"}

    def test_nothing_tracked_and_no_truth(self, tmp_path: Path) -> None:
        recording, slam = clip(), Slam(clip().camera, CONFIG)
        recording.ground_truth = None
        (tmp_path / "plot.png").write_text("of an earlier run")
        summary, evaluation = write_results(tmp_path, slam, [], RunInfo(recording, "default", 0.1))
        assert evaluation is None
        assert summary["evaluation_problem"] == "no ground truth"
        assert summary["consistency"] is None
        assert (summary["frames"], summary["tracked_percent"], summary["track_ms"]) == (0, 0, None)
        assert {path.name for path in tmp_path.iterdir()} == ALWAYS


class TestRealRecordings:
    @pytest.mark.parametrize(
        ("recording", "frames", "limit_m"),
        [
            ("tum/rgbd_dataset_freiburg1_rpy_excerpt", 160, 0.040),
            pytest.param("bonn/rgbd_bonn_crowd", 220, 0.025, marks=pytest.mark.slow),
        ],
    )
    def test_run(self, data_dir: Path, tmp_path: Path, recording: str, frames: int, limit_m: float) -> None:
        main(["run", str(data_dir / recording), "--out", str(tmp_path), "--max-frames", str(frames)])
        assert FILES <= {path.name for path in tmp_path.iterdir()} <= FILES | MASK_FILES
        summary = json.loads((tmp_path / "summary.json").read_text())
        check_summary(summary)
        assert (summary["frames"], summary["tracked"]) == (frames, frames)
        assert summary["ate_rmse_m"] <= limit_m
        assert len(check_against_evo(tmp_path / "trajectory.txt")) == frames

    @pytest.mark.slow
    def test_masks(self, data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """Two people in the picture, and a network that finds them."""
        model = Path(MODELS or "nowhere", "yolox_nano.onnx")
        if not model.is_file():
            pytest.skip("JAXSLAM_MODELS is not set, or holds no yolox_nano.onnx")
        part = ["--start", "300", "--max-frames", "10", "--set", f"semantics.model={model.resolve()}"]
        main(["run", str(data_dir / "bonn/rgbd_bonn_crowd"), "--out", str(tmp_path), *part])
        assert {path.name for path in tmp_path.iterdir()} == FILES | MASK_FILES
        printed = capsys.readouterr().out
        assert all(name in printed for name in FILES | MASK_FILES)
        with Image.open(tmp_path / "masks.png") as sheet:
            assert sheet.width == 4 * 320
