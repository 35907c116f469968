"""Compare what two checkouts compute, to the byte: SHA-256 of trajectories over presets and real recordings.

    JAXSLAM_DATA=... JAXSLAM_MODELS=... python tests/helpers/trajectory_bytes.py OLD_CHECKOUT NEW_CHECKOUT [PRESET ...]

Both run on this machine in one go, since rounding differs between processors; nothing is stored. The exit code is 1 if
a trajectory differs.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

PRESETS = ("default", "static", "ngd", "trs", "usd", "rts", "occlusion")
KITCHEN_CAMERA = Path(__file__).resolve().parents[2] / "configs" / "benchmarks" / "cameras" / "kitchen_people.yaml"
RECORDINGS = {
    "fr1_rpy": ["tum/rgbd_dataset_freiburg1_rpy_excerpt"],
    "bonn_crowd": ["bonn/rgbd_bonn_crowd", "--max-frames", "220"],
    "kitchen_people": ["composite/kitchen_people", "--camera", str(KITCHEN_CAMERA)],
    "kitti_06": ["kitti/sequences/06", "--max-frames", "51"],
}
"""Arguments of `jaxslam run`, the first a folder in `JAXSLAM_DATA`; KITTI with the default preset only."""


def trajectory_sha256(checkout: Path, recording: str, preset: str) -> str:
    """Run a checkout on a recording, deterministically, and hash the trajectory; or the last line of its error."""
    folder, *options = RECORDINGS[recording]
    paths = os.pathsep.join([str(checkout), str(checkout / "kernels")])
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "jaxslam", "run", str(Path(os.environ["JAXSLAM_DATA"]) / folder), *options]
        command += ["--preset", preset, "--out", out]
        done = subprocess.run(
            command, env=os.environ | {"PYTHONPATH": paths}, cwd=out, capture_output=True, text=True, check=False
        )
        file = Path(out) / "trajectory.txt"
        if done.returncode or not file.is_file():
            return (done.stderr.strip().splitlines() or ["no trajectory"])[-1]
        return hashlib.sha256(file.read_bytes()).hexdigest()


def main() -> None:
    """Print a line a run, and exit with 1 if one differs."""
    old, new = (Path(argument).resolve() for argument in sys.argv[1:3])
    different = 0
    for recording in RECORDINGS:
        for preset in sys.argv[3:] or PRESETS:
            if recording == "kitti_06" and preset != "default":
                continue
            hashes = [trajectory_sha256(checkout, recording, preset) for checkout in (old, new)]
            different += hashes[0] != hashes[1]
            verdict = "equal" if hashes[0] == hashes[1] else "DIFFERENT"
            print(f"{recording:15} {preset:10} {verdict:10} {hashes[0][:16]} {hashes[1][:16]}", flush=True)
    sys.exit(1 if different else 0)


if __name__ == "__main__":
    main()
