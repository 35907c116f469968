"""Dense map: a colored point cloud of the static scene, and its occupancy grid."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
