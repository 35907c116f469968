"""The dense map: coloured points of what stands still, and where space is free."""

from jaxslam.dense.cloud import DenseCloud

__all__ = ["DenseCloud"]
