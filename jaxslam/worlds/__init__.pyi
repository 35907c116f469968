from .description import World as World
from .library import load_world as load_world
from .library import worlds as worlds
from .recording import WorldFrame as WorldFrame
from .recording import WorldRecording as WorldRecording
