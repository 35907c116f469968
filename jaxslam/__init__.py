"""jaxslam: differentiable, real-time visual SLAM for dynamic scenes, on a plain CPU.

`Slam` is for robots and recordings, `track_step` for gradients and batches. The public names are listed in
`__init__.pyi`; each is imported from its module when it is first used, so `import jaxslam` costs next to nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
