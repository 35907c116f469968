"""Recordings behind one protocol: `open_dataset(path)` recognizes what a folder holds and opens it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
