"""The pure tracking step: feature flow, pose, rejection of what moves, and the keyframe decision."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
