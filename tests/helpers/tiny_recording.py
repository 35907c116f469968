"""Writes tiny recordings in the layout of TUM, for the tests of loaders and of `doctor`."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from jaxslam.sensors.camera import Camera

WIDTH, HEIGHT, SCALE = 32, 24, 5000.0
CAMERA = Camera("tiny", WIDTH, HEIGHT, 30.0, 30.0, 15.5, 11.5, depth_scale_per_m=SCALE)


def times(count: int, first: float = 100.0, step: float = 1 / 30) -> list[str]:
    return [f"{first + index * step:.6f}" for index in range(count)]


def color(index: int) -> np.ndarray:
    """RGB noise with strong edges, another one for every index."""
    return np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def depth_counts(index: int) -> np.ndarray:
    """A slanted wall 1.5 to 4 meters away, with one pixel in ten missing."""
    counts = np.linspace(1.5 * SCALE, 4 * SCALE, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)
    counts[np.random.default_rng(index).random(counts.shape) < 0.1] = 0
    return counts


def write_list(path: Path, stamps: Sequence[str], folder: str) -> None:
    lines = ["# images", "# timestamp filename", *(f"{stamp} {folder}/{stamp}.png" for stamp in stamps)]
    path.write_text("\n".join(lines) + "\n")


def write_recording(
    folder: Path,
    count: int = 6,
    color_times: Sequence[str] | None = None,
    depth_times: Sequence[str] | None = None,
) -> Path:
    """A recording without ground truth; times are seconds as text and also name the files."""
    color_times = times(count) if color_times is None else color_times
    depth_times = times(count, first=100.002) if depth_times is None else depth_times
    for name, stamps, image in (("rgb", color_times, color), ("depth", depth_times, depth_counts)):
        (folder / name).mkdir(parents=True)
        write_list(folder / f"{name}.txt", stamps, name)
        for index, stamp in enumerate(stamps):
            pixels = image(index)
            pixels = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(folder / name / f"{stamp}.png"), pixels)
    return folder


def write_ground_truth(folder: Path, stamps: Sequence[str]) -> None:
    """A camera that moves along x at 0.3 m a frame without turning."""
    lines = [f"{stamp} {0.3 * index:.4f} 0 0 0 0 0 1" for index, stamp in enumerate(stamps)]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
