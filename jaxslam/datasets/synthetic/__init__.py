"""A furnished room with walking people, rendered: RGB-D recordings with exact ground truth, without any download."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
