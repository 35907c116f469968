"""The command line: help, one-line errors with hints, and `eval` and `doctor` on small files."""

import dataclasses
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from command_line import failing
from tiny_recording import CAMERA, write_recording
from trajectory_files import write_pair

import jaxslam
from jaxslam.cli.command_table import COMMANDS, Command, ExitCode
from jaxslam.cli.entry_point import main
from jaxslam.runtime.machine import cpu_model
from jaxslam.trajectory.trajectory import Trajectory

fails = failing()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "walk")


@pytest.fixture
def trajectories(tmp_path: Path) -> tuple[str, str]:
    """A path, and the same shifted sideways by 1 cm on every second pose."""
    stamps = np.arange(60, dtype=np.int64) * 33_000_000 + 10**15
    poses = np.zeros((60, 7))
    poses[:, 0], poses[:, 4], poses[:, 5] = 1, np.linspace(0, 2, 60), np.sin(np.linspace(0, 6, 60))
    shifted = poses.copy()
    shifted[::2, 6] += 0.01
    return write_pair(tmp_path, Trajectory(stamps, shifted), Trajectory(stamps, poses))


class TestHelp:
    @pytest.mark.parametrize("command", ["demo", "run", "eval", "doctor", "bench", "bench gate"])
    def test_of_a_command(self, capsys: pytest.CaptureFixture[str], command: str) -> None:
        with pytest.raises(SystemExit) as stop:
            main([*command.split(), "--help"])
        assert stop.value.code == 0
        assert f"usage: jaxslam {command}" in " ".join(capsys.readouterr().out.split())

    def test_lists_the_commands(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit) as stop:
            main(["--help"])
        assert stop.value.code == 0
        out = capsys.readouterr().out
        assert all(f"  {command.name} " in out and command.about.split()[0] in out for command in COMMANDS)
        assert all(f"  {int(code)} " in out for code in ExitCode)
        assert all(len(line) <= 80 for line in out.splitlines())

    @pytest.mark.parametrize("command", [command for command in COMMANDS if command.place], ids=lambda c: c.name)
    def test_table_leads_to_options(self, command: Command) -> None:
        """Each name of the table is a dataclass with `main`, whose docstring names it."""
        options = command.options()
        assert dataclasses.is_dataclass(options)
        assert callable(options.main)
        assert f"`jaxslam {command.name}`" in (options.__doc__ or "")

    def test_version(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit) as stop:
            main(["--version"])
        assert stop.value.code == ExitCode.DONE
        out = capsys.readouterr().out
        for text in (f"jaxslam {jaxslam.__version__}", f"JAX {jax.__version__}", f"OpenCV {cv2.__version__}"):
            assert text in out
        assert f"CPU: {cpu_model()}" in out
        assert f"compiled code: {jax.config.values['jax_compilation_cache_dir']}" in out


class TestErrors:
    @pytest.mark.parametrize(
        ("arguments", "expected"),
        [
            (("--set", "track.num_pionts=300"), "track.num_pionts: unknown key (did you mean 'num_points'?)"),
            (("--set", "trak.num_points=300"), "trak: unknown key (did you mean 'track'?)"),
            (("--set", "track.num_points=many"), "num_points"),
            (("--set", "track.num_points"), "expected key=value"),
            (("--preset", "defualt"), "expected a known preset, got 'defualt' (did you mean 'default'?)"),
            (("--dataset", "tmu"), "--dataset: unknown kind 'tmu' (did you mean 'tum'?)"),
            (("--camera", "tum_fr11"), "expected a known name or a YAML file, got 'tum_fr11' (did you mean"),
            (("--max-frames", "0"), "--max-frames: expected at least 1, got 0"),
            (("--camera", "tum_fr1", "--start", "99"), "expected a part of 6 frames"),
            (("--config", "nowhere.yaml"), "nowhere.yaml: cannot be read"),
            ((), "its name does not tell the camera"),
        ],
    )
    def test_of_run(
        self,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        tmp_path: Path,
        recording: Path,
        arguments: tuple[str, ...],
        expected: str,
    ) -> None:
        monkeypatch.chdir(tmp_path)
        assert expected in fails(capsys, "run", str(recording), *arguments)
        assert not Path("results").exists()

    @pytest.mark.parametrize("command", ["run", "doctor"])
    def test_missing_folder(self, capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str) -> None:
        missing = tmp_path / "nowhere"
        expected = f"{missing}: expected the folder of a recording, got nothing there"
        assert fails(capsys, command, str(missing)) == expected

    def test_folder_without_a_recording(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        assert "rgb.txt and depth.txt" in fails(capsys, "run", str(tmp_path))

    def test_eval_of_a_missing_file(
        self, capsys: pytest.CaptureFixture[str], trajectories: tuple[str, str], tmp_path: Path
    ) -> None:
        missing = str(tmp_path / "nowhere.txt")
        assert missing in fails(capsys, "eval", missing, trajectories[1])
        assert missing in fails(capsys, "eval", trajectories[0], missing)

    def test_eval_of_no_trajectory(
        self, capsys: pytest.CaptureFixture[str], trajectories: tuple[str, str], tmp_path: Path
    ) -> None:
        (tmp_path / "words.txt").write_text("once upon a time\n")
        assert "words.txt" in fails(capsys, "eval", str(tmp_path / "words.txt"), trajectories[1])

    def test_unknown_option_is_a_usage_error(self, capsys: pytest.CaptureFixture[str], recording: Path) -> None:
        with pytest.raises(SystemExit) as stop:
            main(["run", str(recording), "--presett", "default"])
        assert stop.value.code == ExitCode.USAGE == 2
        assert "Perhaps you meant" in (err := capsys.readouterr().err)
        assert "--preset STR" in err

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["rnu"], "expected a command, got 'rnu' (did you mean 'run'?)"),
            (["--verion"], "expected a command, got '--verion' (did you mean '--version'?)"),
            (["models", "lst"], "expected a command, got 'lst' (did you mean 'list'?)"),
            (["data", "gte"], "expected a command, got 'gte' (did you mean 'get'?)"),
        ],
    )
    def test_unknown_command_is_a_usage_error(
        self, capsys: pytest.CaptureFixture[str], words: list[str], message: str
    ) -> None:
        assert failing(code=ExitCode.USAGE)(capsys, *words) == message

    @pytest.mark.parametrize(("word", "meant"), [("gaet", "gate"), ("smkoe", "smoke")])
    def test_unknown_suite_or_command_of_bench(self, capsys: pytest.CaptureFixture[str], word: str, meant: str) -> None:
        assert fails(capsys, "bench", word).endswith(f"got '{word}' (did you mean '{meant}'?)")

    @pytest.mark.parametrize("words", [[], ["models"], ["data"]])
    def test_no_command_is_a_usage_error(self, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == ExitCode.USAGE
        err = capsys.readouterr().err
        assert err.startswith("usage: jaxslam")
        assert err.endswith("error: expected a command\n")

    @pytest.mark.skipif(sys.platform == "win32", reason="there is no `head`")
    def test_output_that_nobody_reads(self) -> None:
        """As with `| head -1`: no traceback."""
        code = "from jaxslam.cli.entry_point import main; main(['models', 'list', '--json'])"
        command = f"{sys.executable} -c {shlex.quote(code)} | head -c 1"
        done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
        assert (done.stdout, done.stderr) == ("[", "")


class TestEval:
    def test_prints_the_figures(self, capsys: pytest.CaptureFixture[str], trajectories: tuple[str, str]) -> None:
        main(["eval", *trajectories, "--align", "none"])
        out = capsys.readouterr().out
        assert "ATE w.r.t. translation (without alignment, gap 20 ms)" in out
        assert "0.007071" in out  # 1 cm on every second pose

    @pytest.mark.parametrize(("ending", "begins"), [("pdf", b"%PDF"), ("svg", b"<?xml"), ("PNG", b"\x89PNG")])
    def test_draws_as_its_ending_says(self, trajectories: tuple[str, str], tmp_path: Path, ending: str, begins) -> None:
        files = [tmp_path / f"{name}.{ending}" for name in ("one", "other")]
        for file in files:
            main(["eval", *trajectories, "--plot", str(file)])
        assert files[0].read_bytes().startswith(begins)
        assert files[0].read_bytes() == files[1].read_bytes()

    def test_plot_of_another_ending(
        self, capsys: pytest.CaptureFixture[str], trajectories: tuple[str, str], tmp_path: Path
    ) -> None:
        file = tmp_path / "plot.tiff"
        expected = f"{file}: expected a file that ends in .png, .pdf or .svg, got '.tiff'"
        assert fails(capsys, "eval", *trajectories, "--plot", str(file)) == expected

    def test_draws(self, capsys: pytest.CaptureFixture[str], trajectories: tuple[str, str], tmp_path: Path) -> None:
        main(["eval", *trajectories, "--plot", str(tmp_path / "both.png")])
        assert (tmp_path / "both.png").read_bytes()[:4] == b"\x89PNG"
        assert "ATE" in capsys.readouterr().out


class TestDoctor:
    def test_of_a_recording(self, capsys: pytest.CaptureFixture[str], recording: Path) -> None:
        CAMERA.save(recording / "camera.yaml")
        main(["doctor", str(recording)])
        assert "6" in capsys.readouterr().out

    def test_unfit_recording_is_an_error(self, capsys: pytest.CaptureFixture[str], recording: Path) -> None:
        CAMERA.save(recording / "camera.yaml")
        shutil.rmtree(recording / "depth")
        (recording / "depth").mkdir()
        assert str(recording) in fails(capsys, "doctor", str(recording))
