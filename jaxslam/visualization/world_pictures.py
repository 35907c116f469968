"""Pictures of a world: a contact sheet, a plan with the way of the camera, a clip."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxslam.io.atomic_files import write_atomically
from jaxslam.visualization.overlay import VERMILION, tint
from jaxslam.visualization.picture_files import contact_sheet, small_animation
from jaxslam.visualization.plots import png
from jaxslam.worlds.recording import WorldFrame, WorldRecording

_SHEET_PICTURES, _WIDTH_PX = 16, 320
_CLIP_S, _CLIP_PICTURES = 6.0, 60
_PLAN_STEPS = 400

Progress = Callable[[int, int], None]


def draw_frame(frame: WorldFrame) -> np.ndarray:
    """Draw a frame, with what moves tinted: `(h, 320, 3)` uint8 RGB."""
    image = frame.rgb.copy()
    tint(image, frame.moving_mask, VERMILION)
    height = round(_WIDTH_PX * image.shape[0] / image.shape[1])
    return cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)


def write_world_pictures(recording: WorldRecording, folder: Path, progress: Progress | None = None) -> list[Path]:
    """Write `sheet.png`, `plan.png` and `clip.gif` of a world.

    Args:
        recording: The world.
        folder: Folder of the pictures; made if it does not exist.
        progress: Called after each frame with the number of frames drawn and to be drawn.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    spread = np.unique(np.linspace(0, len(recording) - 1, _SHEET_PICTURES).round().astype(int))
    end = min(len(recording), max(round(_CLIP_S * recording.camera.fps), 1))
    clip = np.unique(np.linspace(0, end - 1, min(_CLIP_PICTURES, end)).round().astype(int))
    pictures: dict[int, np.ndarray] = {}
    wanted = [int(index) for index in dict.fromkeys([*spread, *clip])]
    for done, index in enumerate(wanted, 1):
        pictures[index] = draw_frame(recording.render(index))
        if progress is not None:
            progress(done, len(wanted))
    files = [folder / name for name in ("sheet.png", "plan.png", "clip.gif")]
    write_atomically(files[0], contact_sheet([pictures[int(index)] for index in spread]))
    write_atomically(files[1], _plan(recording))
    frame_ms = round(1000 * end / recording.camera.fps / len(clip))
    write_atomically(files[2], small_animation([pictures[int(index)] for index in clip], frame_ms))
    return files


def _plan(recording: WorldRecording) -> bytes:
    """Rooms and things from above, the way of the camera, and those of things and people."""
    figure = Figure(figsize=(8, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for corners, is_thing in recording.footprints():
        axes.fill(*corners.T, facecolor="tan" if is_thing else "0.55", edgecolor="0.3", linewidth=0.4)
    times = np.linspace(0.0, recording.world.seconds, _PLAN_STEPS)
    for instance in recording.instances:
        position, _, speed = instance.walk(times)
        if np.any(speed > 0.0):
            axes.plot(*position.T, color="tab:red", linewidth=1.0)
            x, y = position[0]
            axes.text(x, y, instance.label, color="tab:red", fontsize=8)
    path = recording.ground_truth.T_world_cam[:, 4:6]
    axes.plot(*path.T, color="tab:blue", linewidth=1.2, label="camera")
    axes.plot(*path[0], "o", color="tab:blue", label="start")
    axes.set(xlabel="x, m", ylabel="y, m", title=recording.world.about, aspect="equal")
    axes.title.set_wrap(True)
    axes.legend(loc="upper right", fontsize=8)
    return png(figure)
