"""Pure tracking step: optical flow, pose estimation, rejection of dynamic points, and the keyframe decision."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
