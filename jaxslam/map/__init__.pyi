from .npz_file import load_map as load_map
from .npz_file import save_map as save_map
from .types import Culled as Culled
from .types import Keyframe as Keyframe
from .types import Loops as Loops
from .types import Map as Map
from .types import MapPoints as MapPoints
from .types import Observations as Observations
