"""Alignment of trajectories and KITTI's drift."""
