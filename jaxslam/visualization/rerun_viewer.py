"""A run in the rerun viewer, or in a recording for it: pictures, masks, points, the path and the map over time.

Needs rerun, which only comes with `pip install 'jaxslam[viz]'`; without it this module cannot be imported. Entities
have the names of rerun's own RGB-D example.
"""

import os
import shutil
import sys
import sysconfig
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from matplotlib import colormaps

from jaxslam.errors import JaxSlamError, TrajectoryError
from jaxslam.geometry.se3 import inverse, transform
from jaxslam.map.types import Map
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.mask_pipeline import MaskSource
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory
from jaxslam.visualization.mask_gallery import MASK_RGB

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as missing:
    raise JaxSlamError(f"rerun cannot be imported ({missing}): pip install 'jaxslam[viz]'") from missing

PathLike: TypeAlias = str | os.PathLike[str]

_CENTER = 0.5
"""What rerun calls the center of the top-left pixel; ours is 0."""
_JPEG_QUALITY = 75
_DEPTH_STEP = 2
"""One depth of so many rows and columns is shown, as a square of that size: half the bytes."""
_DEPTH_PER_M = 1000.0
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 3)
_MAP_EVERY_FRAMES = 30
"""A new map comes with every keyframe, and is a thousand times as large as a pose."""
_FOLLOWED_RGB, _DOUBTED_RGB, _NEW_RGB = (0, 255, 0), (255, 0, 0), (255, 165, 0)
_PATH_RGB, _FINAL_RGB, _TRUTH_RGB, _KEYFRAME_RGB = (31, 119, 180), (44, 160, 44), (153, 153, 153), (255, 128, 0)
_LEVELS = {TrackStatus.WEAK: "WARN", TrackStatus.LOST: "ERROR", TrackStatus.REJECTED: "ERROR"}
_SERIES = {
    "tracking/track_ms": "Time [ms]",
    "tracking/inliers": "Inliers",
    "mask/ratio": "Share of the mask",
    "mask/age": "Age of the mask [frames]",
}


class Viewer:
    """Shows a run in the rerun viewer, or writes it to a file, or both: an `on_frame` of `Slam.run`.

    Timelines are `frame` and `time`. A frame of 640x480 takes 90 to 120 kB, most of it image and depth.
    """

    def __init__(
        self, slam: Slam, truth: Trajectory | None = None, *, path: PathLike | None = None, live: bool = False
    ) -> None:
        """Open the viewer, the file, or both.

        Args:
            slam: System whose run is shown; it is only read.
            truth: True poses of the camera, which are aligned to the tracked ones; `None` if unknown.
            path: File to write, usually `.rrd`; an existing file is replaced. `None` for no file.
            live: Whether to open the viewer, or to use one that is open.

        Raises:
            JaxSlamError: If neither a file nor the viewer is wanted, the file cannot be written, or there is no screen
                or viewer.
        """
        if path is None and not live:
            raise JaxSlamError("viewer: expected a file to write or a live viewer, got neither")
        self._slam, self._truth = slam, truth
        self._stream = rr.RecordingStream("jaxslam")
        files = [] if path is None else [_file(path)]
        self._stream.set_sinks(
            *([_opened_viewer(self._stream)] if live else []), *files, default_blueprint=_blueprint()
        )
        self._frame, self._closed = 0, False
        self._map: Map | None = None
        self._map_since = -_MAP_EVERY_FRAMES
        self._last_center: np.ndarray | None = None
        self._mask_shown = False
        self._said: tuple[TrackStatus, str] | None = None
        self._log_what_stays(slam.camera)

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Show one frame."""
        self._stream.set_time("frame", sequence=self._frame)
        self._stream.set_time("time", timestamp=np.datetime64(result.timestamp_ns, "ns"))
        if isinstance(result, FrameResult):
            if frame is not None:
                self._log_images(frame)
            self._log_mask(result)
            self._log_points(result)
            self._log_pose(result)
            self._log_figures(result)
        self._log_status(result)
        if self._slam.map is not self._map and self._frame >= self._map_since + _MAP_EVERY_FRAMES:
            self._log_map()
        self._frame += 1

    def close(self) -> None:
        """Show the map, the path and the truth as they are known in the end, and write out all that waits."""
        if self._closed:
            return
        self._closed = True
        self._log_map()
        self._log_final_path()
        self._stream.disconnect()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _log_what_stays(self, camera: Camera) -> None:
        pinhole = rr.Pinhole(
            focal_length=(camera.fx, camera.fy),
            principal_point=(camera.cx + _CENTER, camera.cy + _CENTER),
            resolution=(camera.width, camera.height),
            image_plane_distance=0.3,
        )
        classes = [rr.AnnotationInfo(id=0, label="nothing", color=(0, 0, 0, 0))]
        for source in list(MaskSource)[1:]:
            classes.append(rr.AnnotationInfo(id=source, label=source.name.lower(), color=MASK_RGB[source]))
        self._stream.log("world", rr.ViewCoordinates.RDF, static=True)
        self._stream.log("world/camera/image", pinhole, static=True)
        self._stream.log("world/camera/image/mask", rr.AnnotationContext(classes), static=True)
        for entity, name in _SERIES.items():
            self._stream.log(entity, rr.SeriesLines(names=name), static=True)

    def _log_images(self, frame: Frame) -> None:
        self._stream.log("world/camera/image/rgb", rr.Image(frame.image).compress(_JPEG_QUALITY))
        if frame.depth_m is not None:
            depth = rr.EncodedDepthImage(_depth_png(frame.depth_m), media_type="image/png", meter=_DEPTH_PER_M)
            self._stream.log("world/camera/image/depth", depth)

    def _log_mask(self, tracked: FrameResult) -> None:
        shown = bool(tracked.dynamic_mask.any())
        if shown or self._mask_shown:  # one that is empty, to end the one before
            classes = np.uint8(tracked.mask_source) * tracked.dynamic_mask.view(np.uint8)
            self._stream.log("world/camera/image/mask", rr.SegmentationImage(classes, opacity=0.5))
        self._mask_shown = shown

    def _log_points(self, tracked: FrameResult) -> None:
        alive = tracked.weights > 0
        weights, followed = tracked.weights[alive, None], tracked.followed[alive, None]
        believed = weights * np.array(_FOLLOWED_RGB) + (1 - weights) * np.array(_DOUBTED_RGB)
        colors = np.where(followed, believed, np.array(_NEW_RGB)).round().astype(np.uint8)
        points = rr.Points2D(tracked.uv.T[alive] + np.float32(_CENTER), colors=colors, radii=rr.Radius.ui_points(2.0))
        self._stream.log("world/camera/image/points", points)

    def _log_pose(self, tracked: FrameResult) -> None:
        center = tracked.T_world_cam[4:]
        self._stream.log("world/camera", _transform(tracked.T_world_cam))
        known = tracked.status != TrackStatus.LOST
        if known and self._last_center is not None:
            self._stream.log("world/trajectory", _line(np.stack([self._last_center, center]), _PATH_RGB))
        self._last_center = center if known else None

    def _log_figures(self, tracked: FrameResult) -> None:
        figures = (tracked.track_ms, tracked.num_inliers, tracked.dynamic_ratio, tracked.mask_age)
        for entity, figure in zip(_SERIES, figures, strict=True):
            self._stream.log(entity, rr.Scalars(float(figure)))

    def _log_status(self, result: FrameResult | Rejected) -> None:
        """Log the status of the frame where it differs from that of the frame before."""
        said = result.status, result.reason
        if said != self._said:
            text = ": ".join(filter(None, (result.status.name, result.reason)))
            self._stream.log("tracking/status", rr.TextLog(text, level=_LEVELS.get(result.status, "INFO")))
        self._said = said
        if isinstance(result, FrameResult) and result.detector_error:
            self._stream.log("mask/detector_error", rr.TextLog(result.detector_error, level="WARN"))

    def _log_map(self) -> None:
        """Points by how many keyframes saw them, and the places of the keyframes."""
        slam_map = self._slam.map
        if slam_map is self._map:
            return
        self._map, self._map_since = slam_map, self._frame
        seen = np.bincount(
            np.searchsorted(slam_map.points.ids, slam_map.observations.point), minlength=len(slam_map.points.ids)
        )
        colors = colormaps["viridis"](np.clip(0.3 + 0.1 * seen, 0, 1), bytes=True)  # its dark end is lost on black
        points = rr.Points3D(slam_map.points.X_world.T, colors=colors, radii=rr.Radius.ui_points(1.5))
        self._stream.log("world/map/points", points)
        keyframes = rr.Points3D(slam_map.T_world_cam[:, 4:], colors=_KEYFRAME_RGB, radii=rr.Radius.ui_points(4.0))
        self._stream.log("world/map/keyframes", keyframes)

    def _log_final_path(self) -> None:
        path = self._slam.trajectory
        if not len(path):
            return
        self._stream.log("world/trajectory/final", _line(path.positions, _FINAL_RGB))
        if self._truth is None:
            return
        try:
            T_truth_world = evaluate(path, self._truth).T_reference_estimate
        except TrajectoryError as error:
            self._stream.log("tracking/status", rr.TextLog(f"no truth is shown: {error}", level="WARN"))
            return
        during = (self._truth.timestamps_ns >= path.timestamps_ns[0]) & (
            self._truth.timestamps_ns <= path.timestamps_ns[-1]
        )
        aligned = transform(inverse(T_truth_world), self._truth.select(during).positions.T).T
        self._stream.log("world/truth", _line(aligned, _TRUTH_RGB), static=True)


def _file(path: PathLike) -> rr.FileSink:
    try:
        Path(path).write_bytes(b"")  # rerun says more than one line where it cannot
    except OSError as error:
        raise JaxSlamError(f"{path}: cannot be written: {error}") from error
    return rr.FileSink(path)


def _opened_viewer(stream: rr.RecordingStream) -> rr.GrpcSink:
    """The way to a viewer on this machine."""
    if sys.platform == "linux" and not any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        raise JaxSlamError(
            "the viewer needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; a file needs none: --rrd FILE"
        )
    places = os.pathsep.join((sysconfig.get_path("scripts"), os.environ.get("PATH", "")))  # not every shell is in .venv
    try:
        rr.spawn(connect=False, executable_path=shutil.which("rerun", path=places), recording=stream)
    except RuntimeError as error:
        raise JaxSlamError(f"the viewer cannot be started: {str(error).partition(os.linesep)[0]}") from error
    return rr.GrpcSink()


def _depth_png(depth_m: np.ndarray) -> bytes:
    """A coarse depth image of the same size, in millimeters; 0 where there is none or it is beyond 65 m."""
    coarse = depth_m[::_DEPTH_STEP, ::_DEPTH_STEP] * np.float32(_DEPTH_PER_M)
    coarse = np.where((coarse > 0) & (coarse < np.iinfo(np.uint16).max), coarse, 0).round().astype(np.uint16)
    height, width = depth_m.shape
    whole = np.repeat(np.repeat(coarse, _DEPTH_STEP, axis=0), _DEPTH_STEP, axis=1)[:height, :width]
    _, data = cv2.imencode(".png", whole, _PNG)
    return data.tobytes()


def _transform(T_world_cam: np.ndarray) -> rr.Transform3D:
    wxyz = T_world_cam[:4]
    return rr.Transform3D(translation=T_world_cam[4:], quaternion=rr.Quaternion(xyzw=wxyz[[1, 2, 3, 0]]))


def _line(positions: np.ndarray, color: tuple[int, int, int]) -> rr.LineStrips3D:
    """A line through `(n, 3)` places."""
    return rr.LineStrips3D([positions], colors=color, radii=rr.Radius.ui_points(1.5))


def _blueprint() -> rrb.Blueprint:
    """The scene on the left, with the whole path up to now; the picture, depth, words and figures on the right."""
    so_far = rrb.VisibleTimeRange(
        "frame", start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    image = "world/camera/image"
    scene = rrb.Spatial3DView(
        origin="world",
        name="World",
        contents=["$origin/**", f"- {image}/mask", f"- {image}/points"],
        overrides={"world/trajectory": rrb.VisibleTimeRanges(so_far)},
    )
    pictures = rrb.Tabs(
        rrb.Spatial2DView(
            origin=image, name="Image", contents=[f"$origin/{name}" for name in ("rgb", "mask", "points")]
        ),
        rrb.Spatial2DView(origin=image, name="Depth", contents=["$origin/depth"]),
    )
    figures = rrb.Tabs(
        *(rrb.TimeSeriesView(origin=entity, name=name) for entity, name in _SERIES.items()),
        rrb.TextLogView(origin="/", name="Status"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(scene, rrb.Vertical(pictures, figures, row_shares=[3, 2]), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="collapsed"),
    )
