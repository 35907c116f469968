"""What a run leaves in its folder."""

FILES = {
    "trajectory.txt",
    "trajectory_online.txt",
    "trajectory_keyframes.txt",
    "summary.json",
    "config.yaml",
    "plot.png",
    "map.png",
}

MASK_FILES = {"masks.png", "masks.gif"}
"""What there is besides if a frame had a mask."""
