"""Draw `docs/images/demo.png` for the README: a tracked frame with its masks, and the map with the camera's path.

Run `python docs/make_picture.py`. It renders the built-in scene with two walking people and tracks it with their true
masks, so that it needs neither data nor a network.
"""

import io
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from jaxslam import FrameResult, Slam, evaluate, load_config
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, with_true_masks
from jaxslam.visualization.overlay import GREEN, VERMILION, tint

PICTURE = Path(__file__).resolve().parent / "images" / "demo.png"
_SCENE = SyntheticConfig(frames=190, path="halfsphere", people=2)
_SHOWN = 140
_SETTINGS = ("semantics.model=scene", "semantics.labels=[person]", "semantics.frames=every")
_COLORS = 256
"""Colors of the file: with all of them it is larger than 200 KB."""


def main() -> None:
    """Track the scene and write the picture."""
    config = load_config(overrides=_SETTINGS)
    dataset, detector = with_true_masks(SyntheticDataset(_SCENE), config.semantics)
    slam, shown = Slam(dataset.camera, config, detector=detector), np.zeros(0)
    for index, frame in enumerate(dataset):
        result = slam.track(frame)
        if index == _SHOWN:
            shown = with_points(frame.image, result)
    slam.finish()

    figure = Figure(figsize=(9.6, 3.7), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    left.imshow(shown)
    left.set_axis_off()
    left.set_title("one frame: masks and tracked points", fontsize=10)
    draw_map(right, slam, dataset)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    PICTURE.parent.mkdir(exist_ok=True)
    Image.open(drawn).convert("RGB").quantize(_COLORS).save(PICTURE, optimize=True)


def with_points(image: np.ndarray, result: FrameResult) -> np.ndarray:
    """Draw the mask and the tracked points of a frame over its image."""
    picture = image.copy()
    tint(picture, result.dynamic_mask, VERMILION)
    for u, v in result.uv[:, result.followed & (result.weights > 0)].T:
        cv2.circle(picture, (round(float(u)), round(float(v))), 4, GREEN, -1, cv2.LINE_AA)
    return picture


def draw_map(axes: Axes, slam: Slam, dataset: SyntheticDataset) -> None:
    """Draw the map from above, x to the right and z upward, with the keyframes and the camera's path."""
    X_world, path = slam.map.points.X_world, slam.trajectory
    ate_mm = 1e3 * evaluate(path, dataset.ground_truth).ate_rmse_m
    axes.scatter(X_world[0], X_world[2], s=3, color="0.55", linewidths=0, label=f"{X_world.shape[1]} map points")
    axes.plot(path.positions[:, 0], path.positions[:, 2], color="tab:blue", linewidth=2, label="camera path")
    axes.plot(*slam.map.T_world_cam[:, [4, 6]].T, "^", color="black", markersize=4, label="keyframes")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="z [m]", xlim=(-2.8, 2.8), ylim=(-0.5, 5))
    axes.set_title(f"the map from above; ATE {ate_mm:.1f} mm over {len(path)} frames", fontsize=10)
    axes.legend(fontsize=7, loc="lower left", handlelength=1)


if __name__ == "__main__":
    main()
