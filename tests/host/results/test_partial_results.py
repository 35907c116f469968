"""What a run that is killed leaves: the frames up to the last second."""

import csv
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from small_scene import CONFIG, clip

from jaxslam.datasets import Subset
from jaxslam.errors import TrajectoryError
from jaxslam.results.frame_table import write_frames
from jaxslam.results.partial_results import PARTIAL_FILES, PartialResults
from jaxslam.slam.slam import Slam
from jaxslam.trajectory.trajectory import read_tum, write_tum

HELPERS = Path(__file__).parents[2] / "helpers"
KILLED = """
    import os, signal, sys
    from pathlib import Path
    from jaxslam.cli.tracking_run import track
    from jaxslam.results import partial_results
    from jaxslam.slam.slam import Slam

    sys.path.insert(0, sys.argv[2])
    from small_scene import CONFIG, Clip, clip

    class Killed(Clip):
        def __getitem__(self, index):
            if index == 8:
                os.kill(os.getpid(), signal.SIGKILL)
            return super().__getitem__(index)

    partial_results._FLUSH_S = 0.0
    whole = clip()
    track(Killed(whole.source, whole.frames), Slam(whole.camera, CONFIG), "default", Path(sys.argv[1]))
"""


def test_files_grow_with_the_run_and_are_those_of_its_end(tmp_path: Path) -> None:
    recording = Subset(clip(), 0, 8)
    with Slam(recording.camera, CONFIG) as slam, PartialResults(tmp_path) as partial:
        records = slam.run(recording, partial)
        partial._table.flush()
        partial._trajectory.flush()
        write_frames(tmp_path / "frames.csv", records)
        write_tum(tmp_path / "online.txt", slam.online_trajectory)
        table, trajectory = (tmp_path / name for name in PARTIAL_FILES)
        assert table.read_text() == (tmp_path / "frames.csv").read_text()
        partial_poses, poses = read_tum(trajectory), read_tum(tmp_path / "online.txt")
        assert partial_poses.timestamps_ns.tolist() == poses.timestamps_ns.tolist()
        assert abs(partial_poses.T_world_cam - poses.T_world_cam).max() < 1e-6
    assert not any((tmp_path / name).exists() for name in PARTIAL_FILES)


def test_an_error_leaves_them(tmp_path: Path) -> None:
    with pytest.raises(KeyError), PartialResults(tmp_path):
        raise KeyError
    assert all((tmp_path / name).exists() for name in PARTIAL_FILES)


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match="cannot be written"):
        PartialResults(tmp_path / "missing")


def test_a_killed_run_leaves_its_frames(tmp_path: Path) -> None:
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path), str(HELPERS)], check=False)
    assert ended.returncode == -signal.SIGKILL
    with (tmp_path / PARTIAL_FILES[0]).open() as file:
        rows = list(csv.DictReader(file))
    assert rows
    assert {row["status"] for row in rows} <= {"STARTED", "OK", "WEAK"}
    assert len(read_tum(tmp_path / PARTIAL_FILES[1])) == len(rows)
