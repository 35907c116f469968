"""Networks of several families that find people and other movable objects in an image.

A detector is any callable that takes an image and returns `Detections`; `load_detector` makes one from an ONNX file.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
