"""Trajectory files as `jaxslam eval` takes them."""

from pathlib import Path

from jaxslam.trajectory.trajectory import Trajectory, write_tum


def write_pair(folder: Path, estimate: Trajectory, truth: Trajectory) -> tuple[str, str]:
    """Write `estimate.txt` and, in a folder of its own, `truth/groundtruth.txt`; return both paths."""
    (folder / "truth").mkdir()
    paths = folder / "estimate.txt", folder / "truth" / "groundtruth.txt"
    for path, trajectory in zip(paths, (estimate, truth), strict=True):
        write_tum(path, trajectory)
    return str(paths[0]), str(paths[1])
