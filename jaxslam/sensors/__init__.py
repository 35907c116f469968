"""Cameras, stereo rigs, rectification, stereo depth, image files, and the frames that the tracker takes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
