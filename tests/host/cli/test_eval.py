"""`jaxslam eval`: JSON, offsets, frames, and files of other kinds, on the real estimate and truth of fr2_desk."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import failing
from trajectory_files import write_pair

from jaxslam.cli.entry_point import main
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.time_offset import estimate_time_offset
from jaxslam.trajectory.trajectory import Trajectory, read, write_kitti, write_tum

fails = failing("eval")


@pytest.fixture(scope="module")
def pair(data_dir: Path) -> tuple[Trajectory, Trajectory]:
    estimate, reference = (read(data_dir / "trajectories" / f"fr2_desk_{name}.txt") for name in ("ORB", "groundtruth"))
    end = estimate.timestamps_ns[600]
    return estimate.select(np.arange(600)), reference.select(reference.timestamps_ns <= end)


@pytest.fixture
def files(pair: tuple[Trajectory, Trajectory], tmp_path: Path) -> tuple[str, str]:
    return write_pair(tmp_path, *pair)


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    main(["eval", *arguments])
    return capsys.readouterr().out


class TestJson:
    def test_is_the_summary(self, capsys: pytest.CaptureFixture[str], files: tuple[str, str]) -> None:
        expected = evaluate(read(files[0]), read(files[1])).summary()
        assert json.loads(printed(capsys, *files, "--json")) == json.loads(json.dumps(expected))

    def test_is_all_there_is(self, capsys: pytest.CaptureFixture[str], files: tuple[str, str], tmp_path: Path) -> None:
        """Also with a plot, and with words about files, which are notes."""
        (tmp_path / "truth" / "times.txt").write_text("1\n2\n")
        figures = json.loads(printed(capsys, *files, "--json", "--plot", str(tmp_path / "plot.png")))
        assert (tmp_path / "plot.png").is_file()
        assert (figures["num_frames"], figures["coverage_percent"]) == (2, 0)
        assert figures["notes"][0] == f"frames are those of {tmp_path / 'truth' / 'times.txt'}, beside the ground truth"


class TestTimeOffset:
    def test_by_hand(
        self, capsys: pytest.CaptureFixture[str], files: tuple[str, str], pair: tuple[Trajectory, Trajectory]
    ) -> None:
        """What it is without the offset, up to rounding."""
        expected = json.loads(printed(capsys, *files, "--json"))
        write_tum(Path(files[0]), pair[0].shifted(0.05))
        figures = json.loads(printed(capsys, *files, "--json", "--time-offset", "-0.05"))
        assert figures.pop("time_offset_s") == -0.05
        expected.pop("time_offset_s")
        assert figures.keys() == expected.keys()
        for name, value in expected.items():
            assert figures[name] == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value), name

    def test_auto(
        self, capsys: pytest.CaptureFixture[str], files: tuple[str, str], pair: tuple[Trajectory, Trajectory]
    ) -> None:
        right = evaluate(*pair)
        write_tum(Path(files[0]), pair[0].shifted(0.05))
        expected = estimate_time_offset(*pair).seconds - 0.05
        assert f"do the clocks differ? (jaxslam eval --time-offset {expected:.3f})" in printed(capsys, *files)
        text = printed(capsys, *files, "--time-offset", "auto")
        offset = float(text.partition("gap 20 ms, ")[2].partition(" s added to the stamps of the estimate)")[0])
        assert offset == pytest.approx(expected, abs=1e-4)
        assert float(text.partition("ATE  rmse ")[2].partition(" m")[0]) < 1.01 * right.ate_rmse_m

    def test_that_cannot_be_told(
        self, capsys: pytest.CaptureFixture[str], files: tuple[str, str], pair: tuple[Trajectory, Trajectory]
    ) -> None:
        write_tum(Path(files[0]), pair[0].select(np.arange(5)))
        assert fails(capsys, *files, "--time-offset", "auto").startswith("the time offset cannot be estimated: ")


class TestFrames:
    def test_of_the_recording(
        self,
        capsys: pytest.CaptureFixture[str],
        files: tuple[str, str],
        pair: tuple[Trajectory, Trajectory],
        tmp_path: Path,
    ) -> None:
        """Every sixtieth pose is not all of it, though no gap is longer than the others."""
        write_tum(Path(files[0]), pair[0].select(np.arange(0, 600, 60)))
        assert "coverage unknown" in printed(capsys, *files)
        lines = [f"{stamp * 1e-9:.6f} rgb/{stamp}.png\n" for stamp in pair[0].timestamps_ns.tolist()]
        (tmp_path / "list.txt").write_text("# timestamp filename\n" + "".join(lines))
        assert "; 1.7 % of 600 frames covered" in printed(capsys, *files, "--frames", str(tmp_path / "list.txt"))
        (tmp_path / "list.txt").rename(tmp_path / "truth" / "rgb.txt")
        text = printed(capsys, *files)
        assert "; 1.7 % of 600 frames covered" in text
        assert f"note: frames are those of {tmp_path / 'truth' / 'rgb.txt'}, beside the ground truth" in text


class TestFormats:
    def test_truth_of_euroc(
        self,
        capsys: pytest.CaptureFixture[str],
        files: tuple[str, str],
        pair: tuple[Trajectory, Trajectory],
        tmp_path: Path,
    ) -> None:
        rows = (
            f"{stamp}, {', '.join(map(repr, pose[4:] + pose[:4]))}, 0, 0, 0, 0, 0, 0, 0, 0, 0\n"
            for stamp, pose in zip(pair[1].timestamps_ns.tolist(), pair[1].T_world_cam.tolist(), strict=True)
        )
        (tmp_path / "data.csv").write_text("#timestamp [ns], p_RS_R_x [m], ...\n" + "".join(rows))
        figures = json.loads(printed(capsys, files[0], str(tmp_path / "data.csv"), "--json"))
        assert figures["ate_rmse_m"] == pytest.approx(evaluate(*pair).ate_rmse_m, abs=1e-8)

    def test_kitti_with_times(
        self,
        capsys: pytest.CaptureFixture[str],
        files: tuple[str, str],
        pair: tuple[Trajectory, Trajectory],
        tmp_path: Path,
    ) -> None:
        """Rows of KITTI against a truth with stamps."""
        write_kitti(tmp_path / "kitti.txt", pair[0])
        assert "--times FILE" in fails(capsys, str(tmp_path / "kitti.txt"), files[1])
        (tmp_path / "times.txt").write_text("".join(f"{stamp * 1e-9:.6f}\n" for stamp in pair[0].timestamps_ns))
        arguments = [str(tmp_path / "kitti.txt"), files[1], "--times", str(tmp_path / "times.txt"), "--json"]
        assert json.loads(printed(capsys, *arguments))["ate_rmse_m"] == pytest.approx(
            evaluate(*pair).ate_rmse_m, abs=1e-7
        )

    def test_tail_of_kitti(self, capsys: pytest.CaptureFixture[str], data_dir: Path, tmp_path: Path) -> None:
        """The first 100 rows are missing: by row the ATE was 73 m."""
        paths = [data_dir / "trajectories" / f"KITTI_00_{name}.txt" for name in ("ORB", "gt")]
        lines = paths[0].read_text().splitlines(keepends=True)
        (tmp_path / "tail.txt").write_text("".join(lines[100:]))
        problem = fails(capsys, str(tmp_path / "tail.txt"), str(paths[1]))
        assert "tail.txt 4441 (KITTI)" in problem
        assert "--times FILE" in problem
        times = [f"{0.1037 * row:.4f}\n" for row in range(len(lines))]
        for name, part in (("all.txt", times), ("part.txt", times[100:])):
            (tmp_path / name).write_text("".join(part))
        stamps = [str(tmp_path / name) for name in ("part.txt", "all.txt")]
        figures = json.loads(printed(capsys, str(tmp_path / "tail.txt"), str(paths[1]), "--times", *stamps, "--json"))
        assert figures["num_matched"] == 4441
        assert figures["ate_rmse_m"] < 1.5

    def test_rows_in_any_order(
        self, capsys: pytest.CaptureFixture[str], files: tuple[str, str], pair: tuple[Trajectory, Trajectory]
    ) -> None:
        lines = np.array(Path(files[0]).read_text().splitlines())
        Path(files[0]).write_text("\n".join(lines[np.random.default_rng(0).permutation(len(lines))]))
        text = printed(capsys, *files)
        assert f"ATE  rmse {evaluate(*pair).ate_rmse_m:.6f} m" in text
        assert "note: the rows of the estimate were not in the order of time (" in text
