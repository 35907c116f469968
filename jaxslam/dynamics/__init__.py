"""Dynamic cues: pure functions from the measurements of tracked points to a weight for each point."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
