"""Cameras, stereo rigs, rectification, stereo depth, image files, and frames as the tracker takes them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
