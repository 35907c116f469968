"""Depth images: sampling, change, free space, and voxels."""
