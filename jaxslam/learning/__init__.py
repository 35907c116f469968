"""Learn settings through the tracker: losses of trajectories, and gradient descent on whole clips."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
