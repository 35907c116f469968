"""The recipe of the learned cue's weights: which scenes to render, how to train on them, and what to judge by."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import Positive, Range, ValidatedConfig, from_mapping
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.errors import ConfigError
from jaxslam.io.yaml_files import read_mapping

_Frame = Annotated[int, Range(at_least=0)]
_Stride = Annotated[int, Range(at_least=1, at_most=30)]
_Width = Annotated[int, Range(at_least=160, at_most=1280, multiple_of=16)]


@dataclass(frozen=True)
class RoomScene(ValidatedConfig):
    """Frames of a rendered room; see `SyntheticConfig`.

    Attributes:
        seed: Seed of the room.
        path: Path of the camera.
        people: Number of walking people.
        boxes: Number of carried boxes.
        width: Width of the frames, pixels; they are three quarters as high.
        focal: Focal length, as a share of the width.
        start: First frame.
        every: Step from frame to frame, at 30 frames a second.
    """

    seed: Annotated[int, Range(at_least=0, below=2**31)]
    path: CameraPathKind
    people: Annotated[int, Range(at_least=0, at_most=24)] = 0
    boxes: Annotated[int, Range(at_least=0, at_most=24)] = 0
    width: _Width = 320
    focal: Annotated[float, Range(above=0.2, below=5)] = 525 / 640
    start: _Frame = 0
    every: _Stride = 1


@dataclass(frozen=True)
class WorldScene(ValidatedConfig):
    """Frames of a world that comes with jaxslam; left out where the data that it names are not there.

    Attributes:
        world: Name of the world.
        width: Width of the frames, pixels.
        focal: Focal length, as a share of the width. The training on poses takes scenes of one camera only.
        start: First frame.
        every: Step from frame to frame.
    """

    world: str
    width: _Width = 320
    focal: Annotated[float, Range(above=0.2, below=5)] = 525 / 640
    start: _Frame = 0
    every: _Stride = 1


@dataclass(frozen=True)
class StillScene(ValidatedConfig):
    """Frames of a real recording in which nothing moves; left out where it is not there.

    Attributes:
        recording: Folder of the recording, below `JAXSLAM_DATA`.
        start: First frame.
        every: Step from frame to frame.
    """

    recording: str
    start: _Frame = 0
    every: _Stride = 1


@dataclass(frozen=True)
class WeightsRecipe(ValidatedConfig):
    """All that a training of the learned cue depends on besides its seed.

    Attributes:
        frames: Number of frames of each scene.
        rooms: Rendered rooms to train on.
        worlds: Worlds to train on.
        still: Parts of real recordings to train on, in which nothing moves.
        held_out: Rendered rooms that training is judged by, and on which it stops.
        num_hidden: Number of hidden units of the network.
        rounds: How many times the scenes are tracked: first with the cue `clusters`, then with the network trained on
            what was seen so far, whose verdicts decide which points are seen next.
        label_steps: Number of steps of the training on true labels in each round.
        label_rate: Learning rate of that training, which falls to zero.
        moving_weight: Weight of a moving point in it; that of a static one is 1.
        noise: How much the noise of the samples is varied in it: distances of a frame from where static points would be
            are up to `exp(noise)` times as long, and those of a region up to `exp(noise / 2)` times as long or as
            short; points that come to be farther off than any that agreed with the coarse pose agree no more. Rendered
            frames have neither the rolling shutter nor the blur of many cameras.
        window: Number of frames of a window of the training on poses.
        num_windows: Number of windows, spread over the scenes of the smallest width.
        pose_steps: Largest number of steps of the training on poses; 0 to leave it out.
        pose_rate: Learning rate of that training.
        label_share: Weight of the loss of labels beside that of poses.
        temperature: Softness of the verdicts during the training on poses.
    """

    frames: Annotated[int, Range(at_least=10)] = 48
    rooms: tuple[RoomScene, ...] = ()
    worlds: tuple[WorldScene, ...] = ()
    still: tuple[StillScene, ...] = ()
    held_out: tuple[RoomScene, ...] = ()
    num_hidden: Annotated[int, Range(at_least=1, at_most=256)] = 12
    rounds: Annotated[int, Range(at_least=1, at_most=10)] = 2
    label_steps: Annotated[int, Range(at_least=1)] = 1500
    label_rate: Annotated[float, Positive] = 0.01
    moving_weight: Annotated[float, Positive] = 3.0
    noise: Annotated[float, Range(at_least=0, at_most=3)] = 1.5
    window: Annotated[int, Range(at_least=4)] = 12
    num_windows: Annotated[int, Range(at_least=1)] = 16
    pose_steps: Annotated[int, Range(at_least=0)] = 20
    pose_rate: Annotated[float, Positive] = 0.003
    label_share: Annotated[float, Range(at_least=0)] = 1.0
    temperature: Annotated[float, Positive] = 0.2


def load_recipe(path: str | None = None) -> WeightsRecipe:
    """Read a recipe; by default the one with which the weights that come with jaxslam were made.

    Raises:
        ConfigError: If the file cannot be read, a key is unknown, or a value has the wrong type or is out of range.
    """
    file = configs_dir() / "learned_weights.yaml" if path is None else Path(path)
    recipe = from_mapping(WeightsRecipe, read_mapping(file, ConfigError), str(file))
    if not recipe.rooms or not recipe.held_out:
        raise ConfigError(f"{file}: rooms, held_out: expected at least one scene each, got none")
    return recipe
