"""Other systems in the table: their trajectories and programs are judged as ours, or it is said why they are not."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from command_line import failing

from jaxslam.benchmark.external_program import Program, command_words, run_to_its_end
from jaxslam.benchmark.process_clock import ProcessClock
from jaxslam.benchmark.suites.aggregate import rows_of
from jaxslam.benchmark.suites.external_run import ERRORS, PRINTED, ExternalRun, run_system
from jaxslam.benchmark.suites.job import Job
from jaxslam.benchmark.suites.opened_clip import OpenedClip, opened
from jaxslam.benchmark.suites.plan import not_judged, plan
from jaxslam.benchmark.suites.provenance import changes, identities
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.suite import Suite, load_suite
from jaxslam.benchmark.suites.system import System, parse_system
from jaxslam.benchmark.suites.trajectory_folders import trajectories_of
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_tum
from jaxslam.errors import BenchmarkError
from jaxslam.geometry.so3 import matrices
from jaxslam.results.evaluated_run import evaluate_run
from jaxslam.trajectory.trajectory import Trajectory
from jaxslam.trajectory.trajectory import write_tum as write_trajectory

fails = failing("bench")

FRAMES = 24
ROOM = SyntheticConfig(frames=FRAMES, people=0, width=64, height=48)
WHOLE, PART = Clip("room", "room"), Clip("part", "room", start=4, stop=16, every=2)
COPIES = f"{sys.executable} -c 'import shutil, sys; shutil.copy(sys.argv[1] + \"/groundtruth.txt\", sys.argv[2])'"
SLEEPS = (
    "import subprocess, sys, time;"
    " child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']); print(child.pid, flush=True);"
)
"""Begins a program with a child that would sleep for ten minutes, and prints its number."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one recording, `room`."""
    folder = tmp_path_factory.mktemp("recordings")
    write_tum(SyntheticDataset(ROOM), folder / "room")
    return folder


@pytest.fixture
def whole(root: Path) -> OpenedClip:
    return opened(WHOLE, root)


def estimate(given: OpenedClip, error_m: float = 0.01) -> Trajectory:
    """Poses at all frames, on a wavy path around the true one."""
    truth = given.whole.ground_truth
    assert truth is not None
    poses = truth.at(given.whole.timestamps_ns)
    wave = error_m * np.sin(np.arange(len(poses)))[:, None]
    return Trajectory(poses.timestamps_ns, poses.T_world_cam + np.hstack([np.zeros((len(poses), 4)), wave, wave, wave]))


def trajectory_files(folder: Path, given: OpenedClip) -> dict[str, Path]:
    """The same trajectory in every format."""
    poses = estimate(given)
    tum, kitti, euroc, vslamlab = (folder / name for name in ("tum.txt", "kitti.txt", "euroc.csv", "vslamlab.csv"))
    write_trajectory(tum, poses)
    top = np.concatenate([matrices(poses.T_world_cam[:, :4]), poses.positions[:, :, None]], axis=2)
    np.savetxt(kitti, top.reshape(-1, 12), fmt="%.12f")
    rows = list(zip(poses.timestamps_ns.tolist(), poses.T_world_cam.tolist(), strict=True))
    texts = [",".join(map(str, (stamp, x, y, z, qw, qx, qy, qz))) for stamp, (qw, qx, qy, qz, x, y, z) in rows]
    euroc.write_text("\n".join(["#timestamp, p_RS_R_x [m]", *texts]))
    texts = [",".join(map(str, (stamp, x, y, z, qx, qy, qz, qw))) for stamp, (qw, qx, qy, qz, x, y, z) in rows]
    vslamlab.write_text("\n".join(["ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw", *texts]) + "\n")
    return {path.stem: path for path in (tum, kitti, euroc, vslamlab)}


def python(code: str, **options: Any) -> System:
    """A system whose command runs Python with `{recording}` and `{out}` as arguments."""
    return System("other", f'{sys.executable} -c "{code}" {{recording}} {{out}}', **options)


def judged(system: System, given: OpenedClip, folder: Path) -> dict[str, Any]:
    run = run_system(system, 0, given, folder)
    assert run.problem is None
    return run.figures


def problem_of(system: System, given: OpenedClip, folder: Path) -> tuple[str, ExternalRun]:
    run = run_system(system, 0, given, folder)
    assert run.problem is not None
    return run.problem, run


def is_running(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_for_end(pid: int) -> None:
    """Wait until a process that was killed has ended."""
    until = time.monotonic() + 30
    while is_running(pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert not is_running(pid)


class TestTrajectories:
    @pytest.mark.parametrize("kind", ["tum", "kitti", "euroc", "vslamlab"])
    def test_every_format(self, whole: OpenedClip, tmp_path: Path, kind: str) -> None:
        """Judged as one of ours would be, to the digit that the file holds."""
        (tmp_path / "given").mkdir()
        file = trajectory_files(tmp_path, whole)[kind]
        file.rename(tmp_path / "given" / f"room{file.suffix}")
        figures = judged(System("other", trajectories=str(tmp_path / "given")), whole, tmp_path)
        ours = evaluate_run(estimate(whole), whole.dataset).figures
        assert ours["ate_rmse_m"] > 0.005
        for name in ("ate_rmse_m", "ate_sim3_rmse_m", "rpe_trans_m_per_frame"):
            assert figures["evaluation"][name] == pytest.approx(ours["evaluation"][name], rel=1e-5)
        assert figures["ate_rmse_m"] == figures["evaluation"]["ate_rmse_m"]
        assert (figures["frames"], figures["tracked"], figures["tracked_percent"]) == (FRAMES, FRAMES, 100.0)
        assert figures["evaluation"].keys() == ours["evaluation"].keys()
        assert {"trajectory.txt", "errors.csv", "plot.png"} <= {path.name for path in tmp_path.iterdir()}

    def test_part_of_a_recording(self, root: Path, tmp_path: Path) -> None:
        """Poses at other frames do not count."""
        part = opened(PART, root)
        poses = estimate(part)
        far = poses.T_world_cam + np.where(np.isin(poses.timestamps_ns, part.dataset.timestamps_ns), 0.0, 5.0)[:, None]
        (tmp_path / "given").mkdir()
        write_trajectory(
            tmp_path / "given" / "room.txt",
            Trajectory(poses.timestamps_ns, np.hstack([poses.T_world_cam[:, :4], far[:, 4:]])),
        )
        figures = judged(System("other", trajectories=str(tmp_path / "given")), part, tmp_path)
        assert (figures["frames"], figures["tracked"]) == (6, 6)
        assert figures["ate_rmse_m"] < 0.05

    def test_frames_without_a_pose_and_poses_without_a_frame(self, whole: OpenedClip, tmp_path: Path) -> None:
        poses = estimate(whole)
        later = poses.select(np.arange(6, FRAMES))
        extra = later.select(np.array([0]))
        stamps = np.append(later.timestamps_ns, later.timestamps_ns[-1] + 100_000_000)
        (tmp_path / "given").mkdir()
        write_trajectory(
            tmp_path / "given" / "room.txt", Trajectory(stamps, np.vstack([later.T_world_cam, extra.T_world_cam]))
        )
        figures = judged(System("other", trajectories=str(tmp_path / "given")), whole, tmp_path)
        assert (figures["tracked"], figures["tracked_percent"]) == (18, 75.0)
        assert figures["evaluation"]["notes"][0].startswith("1 of 19 poses are at the time of no frame")

    def test_experiment_of_vslamlab(self, whole: OpenedClip, tmp_path: Path) -> None:
        """Its evaluation leaves rows with spaces and without headings; a note says that they are of keyframes."""
        folder = tmp_path / "exp_other" / "RGBDTUM" / "room"
        folder.mkdir(parents=True)
        file = trajectory_files(tmp_path, whole)["vslamlab"]
        rows = file.read_text().splitlines()[1:]
        (folder / "00001_KeyFrameTrajectory.csv").write_text("\n".join(rows[::-1]).replace(",", " "))
        (folder / "00000_KeyFrameTrajectory.csv").write_text(file.read_text())
        (folder / "system_output_00000.txt").write_text("Shutdown\n")
        system = System("other", trajectories=str(tmp_path / "exp_other"))
        assert [path.name[:5] for path in trajectories_of(tmp_path / "exp_other", WHOLE)] == ["00000", "00001"]
        first, second = (run_system(system, number, whole, tmp_path) for number in range(2))
        assert first.problem is second.problem is None
        assert first.figures["ate_rmse_m"] == pytest.approx(second.figures["ate_rmse_m"], rel=1e-9)
        notes = second.figures["evaluation"]["notes"]
        assert notes[0].startswith("the rows of the trajectory were not in the order of time")
        assert notes[1].startswith("poses of keyframes alone")

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "room.txt: holds no poses"),
            ("1.0 0 0\n", r"room.txt:1: expected 8 \(TUM\) or 12 \(KITTI\) columns, found 3"),
            ("1.0 0 0 0 0 0 0 1\n1.1 0 0 nan 0 0 0 1\n", "room.txt:2: holds a number that is not finite"),
            ("1.0 0 0 0 0 0 0 1\n1.1 0 0 zero 0 0 0 1\n", "room.txt:2: expected 8 numbers"),
            ("1.0 0 0 0 0 0 0 3\n", "room.txt:1: the quaternion is not of unit length"),
            ("1305031102175304000 0 0 0 0 0 0 1\n", r"room.txt:1: expected a timestamp in seconds.*\(nanoseconds\?\)"),
            ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 7, f"expected a row a frame, {FRAMES}, got 7"),
            ("9000.0 0 0 0 0 0 0 1\n9001.0 0 0 0 0 0 0 1\n", "no pose within 20 ms of a frame: 2 poses from 9000.000"),
            ("\x00\xff", "room.txt"),
        ],
        ids=["empty", "columns", "nan", "word", "quaternion", "nanoseconds", "kitti", "other-times", "binary"],
    )
    def test_damaged(self, whole: OpenedClip, tmp_path: Path, text: str, message: str) -> None:
        (tmp_path / "given").mkdir()
        (tmp_path / "given" / "room.txt").write_bytes(text.encode("latin-1"))
        problem, run = problem_of(System("other", trajectories=str(tmp_path / "given")), whole, tmp_path)
        assert re.search(message, problem)
        assert run.figures["ate_rmse_m"] is None
        assert not (tmp_path / "trajectory.txt").exists()

    def test_too_few_to_align(self, whole: OpenedClip, tmp_path: Path) -> None:
        """As of ours: it was tracked, and has no ATE."""
        (tmp_path / "given").mkdir()
        write_trajectory(tmp_path / "given" / "room.txt", estimate(whole).select(np.arange(2)))
        figures = judged(System("other", trajectories=str(tmp_path / "given")), whole, tmp_path)
        assert figures["ate_rmse_m"] is None
        assert figures["tracked"] == 2
        assert "alignment needs 3 matches" in figures["evaluation_problem"]


class TestPrograms:
    def test_is_judged_and_timed(self, whole: OpenedClip, tmp_path: Path) -> None:
        code = (
            "import shutil, sys, time; held = bytearray(150_000_000); sum(range(4_000_000)); time.sleep(0.3);"
            " shutil.copy(sys.argv[1] + '/groundtruth.txt', sys.argv[2]); print('done');"
            " print('warned', file=sys.stderr)"
        )
        figures = judged(python(code), whole, tmp_path)
        assert figures["ate_rmse_m"] < 1e-4
        assert (figures["exit_code"], figures["timed_out"]) == (0, False)
        assert figures["process_wall_s"] >= 0.3
        assert figures["process_cpu_s"] > 0
        assert figures["peak_rss_mb"] > 150
        assert (tmp_path / PRINTED).read_text() == "done\n"
        assert (tmp_path / ERRORS).read_text() == "warned\n"

    def test_figures_that_it_prints(self, whole: OpenedClip, tmp_path: Path) -> None:
        code = "import shutil, sys; shutil.copy(sys.argv[1] + '/groundtruth.txt', sys.argv[2])"
        words = "; print('24 frames, 24 OK; median 9.5 ms, p95 12; processor time 20 ms')"
        figures = judged(python(code + words, prints_figures=True), whole, tmp_path)
        assert figures["track_ms"] == {"median": 9.5, "p95": 12.0, "max": None}
        (row,) = rows_of([{"sequence": "room", "label": "other", "status": "done", **figures}])
        assert (row["track_ms_median"]["median"], row["track_ms_max"]) == (9.5, None)
        problem, _ = problem_of(python(code, prints_figures=True), whole, tmp_path)
        assert problem.startswith(
            "other: expected frames, tracked, median_ms, p95_ms, cpu_ms in what it prints, got no"
        )

    def test_placeholders(self, root: Path, tmp_path: Path) -> None:
        """The command knows the part and the camera; it is run where the suite is, and words are split before."""
        part = opened(PART, root)
        (tmp_path / "suite folder").mkdir()
        code = "import json, sys; json.dump(sys.argv[1:], open('told', 'w'))"
        (tmp_path / "suite folder" / "show.py").write_text(code)
        names = ("recording", "calibration", "out", "start", "stop", "every", "rate", "seed")
        command = f"{sys.executable} show.py 'a b' " + " ".join(f"{{{name}}}" for name in names)
        system = System("other", command, folder=str(tmp_path / "suite folder"))
        out = tmp_path / "run folder"
        out.mkdir()
        problem = run_system(system, 3, part, out).problem
        assert problem == f"other: expected a trajectory in {{out}}, {out / 'program_trajectory.txt'}; it wrote none"
        told = json.loads((tmp_path / "suite folder" / "told").read_text())
        assert told == [
            *("a b", str(root / "room"), str(out / "calibration.yaml"), str(out / "program_trajectory.txt")),
            *("4", "16", "2", "15", "3"),
        ]
        assert "fx: " in (out / "calibration.yaml").read_text()

    def test_whole_recording_instead_of_a_part(self, root: Path, tmp_path: Path) -> None:
        figures = judged(System("other", f"{COPIES} {{recording}} {{out}}"), opened(PART, root), tmp_path)
        assert figures["tracked"] == 6
        assert "the program was given the whole recording" in figures["evaluation"]["notes"][0]

    def test_room_is_written_for_it(self, tmp_path: Path) -> None:
        code = (
            "import os, shutil, sys; print(sorted(os.listdir(sys.argv[1])));"
            " shutil.copy(sys.argv[1] + '/groundtruth.txt', sys.argv[2])"
        )
        figures = judged(python(code), opened(Clip("room", room=ROOM), None), tmp_path)
        assert figures["ate_rmse_m"] < 1e-4
        assert "'rgb.txt'" in (tmp_path / PRINTED).read_text()
        assert not (tmp_path / "recording").exists()

    def test_platform_of_jax_is_not_ours(
        self, whole: OpenedClip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A command of jaxslam computes on the CPU; another program may have a GPU."""
        monkeypatch.setenv("JAX_PLATFORMS", "cpu")
        monkeypatch.setenv("JAXSLAM_CHOSE_PLATFORM", "1")
        problem_of(python("import os; print(os.environ.get('JAX_PLATFORMS'))"), whole, tmp_path)
        assert (tmp_path / PRINTED).read_text() == "None\n"

    def test_exit_code(self, whole: OpenedClip, tmp_path: Path) -> None:
        problem, run = problem_of(python("raise SystemExit('no vocabulary')"), whole, tmp_path)
        assert problem == "other: ended with 1: no vocabulary"
        assert (run.figures["exit_code"], run.figures["timed_out"]) == (1, False)
        assert (tmp_path / ERRORS).read_text() == "no vocabulary\n"

    def test_killed_by_a_signal(self, whole: OpenedClip, tmp_path: Path) -> None:
        problem, run = problem_of(python("import os; os.kill(os.getpid(), 11)"), whole, tmp_path)
        assert problem.startswith("other: killed by signal 11")
        assert run.figures["exit_code"] == -11

    def test_no_such_command(self, whole: OpenedClip, tmp_path: Path) -> None:
        problem, run = problem_of(System("other", "/nowhere/slam {recording} {out}"), whole, tmp_path)
        assert problem == "other: '/nowhere/slam' cannot be run: No such file or directory"
        assert "exit_code" not in run.figures

    def test_hangs(self, whole: OpenedClip, tmp_path: Path) -> None:
        """It is killed with the child that it has started, which would have slept for ten minutes."""
        code = SLEEPS + " time.sleep(600)"
        problem, run = problem_of(python(code, limit_s=2.0), whole, tmp_path)
        assert problem == "other: timed out after 2 s and was killed"
        assert (run.figures["exit_code"], run.figures["timed_out"]) == (None, True)
        wait_for_end(int((tmp_path / PRINTED).read_text()))

    def test_child_that_outlives_it(self, tmp_path: Path) -> None:
        """It is no reason to wait, and does not stay."""
        with (tmp_path / "printed").open("wb") as printed, (tmp_path / "errors").open("wb") as errors:
            ended = run_to_its_end(Program("other", (sys.executable, "-c", SLEEPS)), printed, errors, limit_s=300)
        assert ended.exit_code == 0
        wait_for_end(int((tmp_path / "printed").read_text()))

    def test_no_shell(self) -> None:
        assert command_words("run 'a b' $HOME; {out}", {"out": "x y"}, "-") == ("run", "a b", "$HOME;", "x y")

    def test_clock_that_is_stopped(self, monkeypatch: pytest.MonkeyPatch) -> None:
        now = {"time": 100.0, "process_time": 1.0}
        monkeypatch.setattr(time, "time", lambda: now["time"])
        monkeypatch.setattr(time, "process_time", lambda: now["process_time"])
        clock = ProcessClock(98.0)
        with clock.stopped():
            now |= {"time": 110.0, "process_time": 5.0}
        now |= {"time": 111.0, "process_time": 5.5}
        assert clock.figures() == {"process_wall_s": 3.0, "process_cpu_s": 1.5}


class TestFolders:
    @pytest.mark.parametrize(
        ("clip", "files", "found"),
        [
            (WHOLE, ["room.txt", "other.txt"], ["room.txt"]),
            (WHOLE, ["room.tum"], ["room.tum"]),
            (PART, ["room.txt", "part.csv"], ["part.csv"]),
            (WHOLE, ["room/10.txt", "room/2.txt", "room/notes.txt"], ["2.txt", "10.txt"]),
            (Clip("kitti_06", "kitti_06"), ["06.txt", "00.txt"], ["06.txt"]),
            (Clip("kitti_06", "kitti_06"), ["KITTI/06/00000_KeyFrameTrajectory.txt"], ["00000_KeyFrameTrajectory.txt"]),
            (WHOLE, ["rooms.txt"], []),
        ],
        ids=["file", "ending", "own-name-first", "runs", "kitti", "vslam-lab", "none"],
    )
    def test_layouts(self, tmp_path: Path, clip: Clip, files: list[str], found: list[str]) -> None:
        for file in files:
            (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / file).touch()
        assert [path.name for path in trajectories_of(tmp_path, clip)] == found

    def test_two_of_one_run(self, tmp_path: Path) -> None:
        for name in ("room.txt", "room.csv"):
            (tmp_path / name).touch()
        with pytest.raises(BenchmarkError, match=r"expected one trajectory a run, got .*room\.txt and .*room\.csv"):
            trajectories_of(tmp_path, WHOLE)

    def test_sequences_without_one(self, tmp_path: Path) -> None:
        """They are named; if that is every sequence, it is an error that says what was looked for."""
        system = parse_system(f"other={tmp_path}")
        suite = Suite("any", "", (WHOLE, Clip("hall", "hall")), systems=(system,))
        (tmp_path / "Room.txt").touch()
        with pytest.raises(BenchmarkError, match=r"other: expected trajectories such as room.txt.*, got Room.txt"):
            not_judged(suite, ())
        (tmp_path / "room.txt").touch()
        assert not_judged(suite, ()) == {"hall, other": f"no trajectory in {tmp_path}"}
        assert not_judged(suite, {"hall"}) == {}
        assert [(job.clip.name, job.label) for job in plan(suite, presets=("static",))] == [
            ("room", "static"), ("room", "other"), ("hall", "static")
        ]  # fmt: skip

    def test_what_was_judged_is_known(self, root: Path, tmp_path: Path) -> None:
        """A trajectory or a script that has changed is judged or run again."""
        (tmp_path / "room.txt").write_text("1")
        (tmp_path / "run.py").write_text("1")
        given = parse_system(f"other={tmp_path}")
        made = System("program", "python run.py {recording} {out}", folder=str(tmp_path))
        jobs = [Job(WHOLE, system.name, "", (), 0, system) for system in (given, made)]
        assert [Job.of_json(job.to_json()) for job in jobs] == jobs
        before = identities(jobs, root)
        assert before == identities(jobs, root)
        (tmp_path / "room.txt").write_text("2")
        (tmp_path / "run.py").write_text("2")
        after = identities(jobs, root)
        for then, now in zip(before, after, strict=True):
            assert changes(then, now) == ["the trajectory, or a file that the command names, has changed"]


class TestSuiteFile:
    TEXT = "presets: []\nsequences: [{recording: room}]\nsystems:\n"

    def loaded(self, folder: Path, systems: str) -> Suite:
        (folder / "mine.yaml").write_text(self.TEXT + systems)
        return load_suite(str(folder / "mine.yaml"))

    def test_beside_the_file(self, tmp_path: Path) -> None:
        (tmp_path / "given").mkdir()
        command = "  made: {command: 'run.py {recording} {out}', limit_s: 5}\n"
        suite = self.loaded(tmp_path, command + "  given: {trajectories: given}\n")
        assert suite.presets == ()
        assert suite.systems == (
            System("made", "run.py {recording} {out}", limit_s=5.0, folder=str(tmp_path)),
            System("given", trajectories=str(tmp_path / "given")),
        )

    @pytest.mark.parametrize(
        ("systems", "message"),
        [
            ("  a: {}\n", "a: expected either `command` or `trajectories`, got none"),
            ("  a: {command: 'x {recording} {out}', trajectories: y}\n", "got both"),
            ("  a: {command: 'x {recording}'}\n", r"a: command: expected \{out\} in it"),
            (
                "  a: {command: 'x {recordin} {out}'}\n",
                r"a: command: expected a command with \{recording\}, .* at most",
            ),
            ("  a: {command: 'x {recording} {out} \"'}\n", "No closing quotation"),
            ("  a: {command: [x]}\n", "a: command: expected text"),
            ("  a: {command: 'x {recording} {out}', limit_s: 0}\n", "a: limit_s: expected a finite number > 0, got 0"),
            ("  a: {comand: x}\n", "unknown key 'comand' .did you mean 'command'"),
            ("  a: {trajectories: nowhere}\n", "a: expected a folder of trajectories, got '.*nowhere'"),
            ("  static: {command: 'x {recording} {out}'}\n", "'static' is a preset"),
            ("  a@b: {command: 'x {recording} {out}'}\n", "expected a name without '@'"),
        ],
    )
    def test_wrong(self, tmp_path: Path, systems: str, message: str) -> None:
        with pytest.raises(BenchmarkError, match=message):
            self.loaded(tmp_path, systems)

    @pytest.mark.parametrize(
        ("text", "message"),
        [("other", "expected NAME=DIR, got 'other'"), ("=x", "expected NAME=DIR"), ("a=/nowhere", "names commands")],
    )
    def test_wrong_option(self, text: str, message: str) -> None:
        with pytest.raises(BenchmarkError, match=f"--with: .*{message}"):
            parse_system(text)


@pytest.mark.slow
def test_table_with_others(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What can be judged is in every table and plot; what cannot is a row with its reason, and the suite goes on."""
    given = opened(WHOLE, root)
    (tmp_path / "given").mkdir()
    write_trajectory(tmp_path / "given" / "room.txt", estimate(given))
    systems = (
        "  missing: {command: '/nowhere/slam {recording} {out}'}\n"
        f'  fails: {{command: "{sys.executable} -c raise(SystemExit(1)) {{recording}} {{out}}"}}\n'
        "  copies: {command: 'cp {recording}/groundtruth.txt {out}'}\n"
    )
    suite = tmp_path / "mine.yaml"
    suite.write_text(TestSuiteFile.TEXT + systems)
    words = [str(suite), "--root", str(root), "--with", f"given={tmp_path / 'given'}", "--out", str(tmp_path / "out")]
    assert "2 of 4 runs failed" in fails(capsys, *words)
    results = {run["label"]: run for run in json.loads((tmp_path / "out" / "results.json").read_text())}
    assert {label: run["status"] for label, run in results.items()} == {
        "missing": "failed", "fails": "failed", "copies": "done", "given": "done"
    }  # fmt: skip
    assert len({tuple(run) for run in results.values()}) == 1
    assert results["fails"]["exit_code"] == 1
    assert results["given"]["ate_rmse_m"] == pytest.approx(
        evaluate_run(estimate(given), given.dataset).figures["ate_rmse_m"], rel=1e-5
    )
    report = (tmp_path / "out" / "report.md").read_text()
    assert "| copies | 1 of 1 | 24 | 100.0 |" in report
    assert "fails: 1 runs failed: fails: ended with 1" in report
    assert "missing: 1 runs failed: missing: '/nowhere/slam' cannot be run: No such file or directory" in report
    assert re.search(r"\| preset \| runs \|.* wall, s \| processor, s \| memory, MB \|", report)
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<img") == 3  # errors, paths, errors over time; nothing tells the times of frames
    capsys.readouterr()
    kept = (tmp_path / "out" / "room" / "copies" / "0" / "result.json").stat().st_mtime_ns
    fails(capsys, *words, "--resume")
    assert (tmp_path / "out" / "room" / "copies" / "0" / "result.json").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_suite_that_is_killed(root: Path, tmp_path: Path) -> None:
    """The program of another system and its child do not outlive it."""
    (tmp_path / "sleeps.py").write_text(SLEEPS + " time.sleep(600)")
    text = TestSuiteFile.TEXT + f"  sleeps: {{command: '{sys.executable} sleeps.py {{recording}} {{out}}'}}\n"
    (tmp_path / "mine.yaml").write_text(text)
    program = "from jaxslam.cli.entry_point import main; main()"
    words = ["bench", str(tmp_path / "mine.yaml"), "--root", str(root), "--out", str(tmp_path / "out")]
    process = subprocess.Popen([sys.executable, "-c", program, *words])
    printed, until = tmp_path / "out" / "room" / "sleeps" / "0" / PRINTED, time.monotonic() + 120
    while not (printed.is_file() and printed.read_text().endswith("\n")) and time.monotonic() < until:
        time.sleep(0.05)
    child = int(printed.read_text())
    parent = psutil.Process(child).ppid()
    assert is_running(parent)
    process.kill()
    process.wait()
    wait_for_end(child)
    wait_for_end(parent)


def test_other_commands_know_no_systems(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.yaml").write_text(TestSuiteFile.TEXT + "  a: {command: 'x {recording} {out}'}\n")
    words = ["gate", "--baseline", str(tmp_path / "b.json"), "--of", str(tmp_path / "mine.yaml"), "--update", "why"]
    assert "systems: expected none for this command, got a" in fails(capsys, *words)
    dask = [str(tmp_path / "mine.yaml"), "--executor", "dask://nowhere:1", "--out", str(tmp_path / "out")]
    assert "--executor: expected local for other systems" in fails(capsys, *dask)
