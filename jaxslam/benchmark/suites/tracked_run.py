"""One run of jaxslam: the sequence is tracked with a preset, and the files of the run are written."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from jaxslam.benchmark.process_clock import ProcessClock
from jaxslam.benchmark.reference_flow import flow_time_ms
from jaxslam.benchmark.suites.opened_clip import OpenedClip
from jaxslam.benchmark.suites.provenance import networks_sha256
from jaxslam.config.schema import Config
from jaxslam.datasets import imu_sheet
from jaxslam.datasets.synthetic import with_true_masks
from jaxslam.results.run_results import RunInfo, write_results
from jaxslam.semantics.from_config import preset_needs_network
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.relative_pose_log import RelativePoseLog
from jaxslam.slam.slam import Slam
from jaxslam.visualization.snapshots import RunPictures


def track(given: OpenedClip, preset: str, config: Config, folder: Path, clock: ProcessClock) -> dict[str, Any]:
    """Track a sequence, write the files of the run, and return its figures.

    Args:
        given: Sequence to track.
        preset: Name of the preset.
        config: Every setting of the run.
        folder: Folder for the files.
        clock: Clock of this process, read when the last frame has been tracked.

    Raises:
        JaxSlamError: If the recording is not fit to be tracked, or a file cannot be written.
    """
    with clock.stopped():
        dataset, truth = with_true_masks(given.dataset, config.semantics)
        flow_ms = flow_time_ms(dataset)
    pictures, poses = RunPictures(len(dataset)), RelativePoseLog()

    def watch(frame: Frame | None, result: FrameResult | Rejected) -> None:
        pictures(frame, result)
        poses(frame, result)

    slam = Slam(dataset.camera, config, detector=truth, imu=imu_sheet(dataset))
    slam.warm_up()
    began = time.perf_counter()
    with slam:
        records = slam.run(dataset, watch)
    info = RunInfo(dataset, preset, time.perf_counter() - began)
    of_process = clock.figures()
    summary, _ = write_results(folder, slam, records, info, pictures, poses.poses())
    times = summary["track_ms"]
    ratios = {} if flow_ms is None else {f"flow_ratio_{name}": round(times[name] / flow_ms, 4) for name in times or ()}
    return {
        **summary,
        **of_process,
        "flow_ms": None if flow_ms is None else round(flow_ms, 4),
        **ratios,
        "lacks_network": slam.without_network is not None and preset_needs_network(preset),
        "networks_sha256": networks_sha256(config.semantics),
        "config": dataclasses.asdict(config),
    }
