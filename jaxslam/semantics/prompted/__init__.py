"""Segmenters with prompts: points and boxes (SAM), or an image with its mask (SegGPT)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
