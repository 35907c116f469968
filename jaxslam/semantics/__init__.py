"""Networks that find people and other movable things in an image, whatever family they are of.

A detector is any callable that takes an image and returns `Detections`; `load_detector` makes one of an ONNX file.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
