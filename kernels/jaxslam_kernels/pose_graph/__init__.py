"""Pose graph optimization, dense and sparse."""
