"""The description of a world: dataclasses, and YAML files of the same.

Axes of a world: x and y on the floor, z up, in meters. Angles are in degrees, counterclockwise seen from above; 0 faces
along x. Axes of a thing: x ahead, y to its left, z up, origin on the floor under its middle.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
