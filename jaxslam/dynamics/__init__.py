"""Cues to what moves: pure functions from what a frame shows of the points to how much each of them counts."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
