"""Trajectories, their file formats, and their evaluation: ATE, RPE, KITTI drift, coverage, consistency."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
