"""One live run of jaxslam in a process of its own: images are loaded before the clock starts.

`python -m jaxslam.benchmark.live.own_run --recording=FOLDER ...` prints `LiveFigures` as a line of JSON.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxslam.benchmark.live.figures import LiveFigures
from jaxslam.config.loading import load_config
from jaxslam.datasets import Dataset, Subset, imu_samples, imu_sheet, open_dataset
from jaxslam.datasets.protocol import with_imu
from jaxslam.errors import TrajectoryError
from jaxslam.runtime.compile_cache import enable_compile_cache
from jaxslam.runtime.garbage import garbage_frozen
from jaxslam.sensors.frame import Frame
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate

OPTIONS = ("recording", "rate", "start", "stop", "every", "preset")
"""Options of a run, each given as `--NAME=VALUE`; settings follow as `--set=KEY=VALUE`."""


def live_run(dataset: Dataset, rate_hz: float, preset: str, settings: Sequence[str]) -> LiveFigures:
    """Track a recording, each frame when it is due; one that is late is tracked as soon as the one before is done.

    Args:
        dataset: The recording.
        rate_hz: Frames a second.
        preset: Preset to start from.
        settings: Settings as `key=value`.
    """
    config = load_config(preset, None, ("run.deterministic=false", *settings))
    frames = list(_frames(dataset))
    took_s, late, tracked = [], 0, 0
    with Slam(dataset.camera, config, imu=imu_sheet(dataset)) as slam:
        slam.warm_up()
        with garbage_frozen():
            began, processor_s = time.perf_counter(), time.process_time()
            for number, frame in enumerate(frames):
                wait_s = began + number / rate_hz - time.perf_counter()
                late += wait_s < 0 < number
                time.sleep(max(0.0, wait_s))
                start = time.perf_counter()
                result = slam.track(frame)
                took_s.append(time.perf_counter() - start)
                tracked += result.status != TrackStatus.LOST
            processor_s = time.process_time() - processor_s
        slam.finish()
        trajectory = slam.trajectory
    try:
        ate_m = None if dataset.ground_truth is None else evaluate(trajectory, dataset.ground_truth).ate_rmse_m
    except TrajectoryError:  # too few poses with a truth
        ate_m = None
    ms = 1e3 * np.array(took_s)
    return LiveFigures(
        frames=len(frames),
        tracked=tracked,
        median_ms=float(np.median(ms)),
        p95_ms=float(np.percentile(ms, 95)),
        max_ms=float(ms.max()),
        cpu_ms=1e3 * processor_s / len(frames),
        late=late,
        ate_m=ate_m,
    )


def _frames(dataset: Dataset) -> Iterator[Frame]:
    """Read all frames, each with the samples of the IMU since the one before."""
    samples, last_ns = imu_samples(dataset), None
    for index in range(len(dataset)):
        frame = dataset[index]
        yield with_imu(frame, samples, last_ns)
        last_ns = frame.timestamp_ns


def main() -> None:
    """Run once, and print the figures."""
    parser = argparse.ArgumentParser()
    for name in OPTIONS:
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--set", action="append", default=[])
    given = parser.parse_args()
    enable_compile_cache()
    dataset = Subset(open_dataset(Path(given.recording)), int(given.start), int(given.stop), int(given.every))
    print(live_run(dataset, float(given.rate), given.preset, given.set).as_json())


if __name__ == "__main__":
    main()
