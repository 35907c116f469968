"""The whole system: `Slam`, its back end and masks, the threads they run in, and what a frame gives."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
