"""Immutable map of keyframes and points: types, edits, invariants, files, export."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
