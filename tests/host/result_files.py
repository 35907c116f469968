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
