"""What a run leaves in its folder."""

ALWAYS = {"trajectory.txt", "trajectory_online.txt", "frames.csv", "summary.json", "config.yaml"}

FILES = ALWAYS | {
    "trajectory_keyframes.txt",
    "plot.png",
    "trajectory_kitti.txt",
    "map.png",
    "errors.csv",
    "consistency.png",
    "failures.png",
}
"""Of a run with poses, keyframes and a ground truth."""

MASK_FILES = {"masks.png", "masks.gif"}
"""What there is besides if a frame had a mask."""
