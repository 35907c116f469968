"""All settings: frozen dataclasses hold the only defaults; presets, files and overrides hold differences.

Precedence: overrides (the command line) > file > preset > defaults.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml

from jaxslam.config.validation import Range, ValidatedConfig, checked_value, field_hints, section_of
from jaxslam.errors import ConfigError, nearest, one_line
from jaxslam.io.yaml_files import parse_yaml, read_mapping

_Section = TypeVar("_Section")


Positive = Range(above=0)
Share = Range(at_least=0, at_most=1)


@dataclass(frozen=True)
class TrackConfig(ValidatedConfig):
    """The tracker: what happens to every frame. Whole numbers are sizes: changing one compiles anew."""

    num_points: Annotated[int, Range(at_least=32, at_most=4096)] = 512
    """Points followed from frame to frame."""
    num_levels: Annotated[int, Range(at_least=2, at_most=6)] = 4
    """Levels of the image pyramid; one more follows motions twice as fast."""
    num_keyframes: Annotated[int, Range(at_least=1, at_most=64)] = 12
    """Latest keyframes kept to look points up in again."""
    num_reloaded: Annotated[int, Range(at_least=0, at_most=64)] = 4
    """Further keyframes to look into, reloaded from the map where the camera comes back."""
    num_sources: Annotated[int, Range(at_least=0, at_most=8)] = 2
    """How many of the keyframes are looked into in a frame; 0 for following from frame to frame alone."""
    points_per_source: Annotated[int, Range(at_least=16, at_most=2048)] = 160
    """Points looked up from each of them."""
    num_hypotheses: Annotated[int, Range(at_least=16, at_most=1024)] = 64
    """Pose hypotheses a frame."""
    cell_px: Annotated[int, Range(at_least=8, at_most=80, multiple_of=2)] = 20
    """Side of the grid cells that each get at most one new corner, pixels, even."""
    new_points: Literal["always", "keyframes"] = "always"
    """In which frames new points are sought, where there are few."""
    match_map: Literal["weak", "keyframes", "always"] = "weak"
    """Which frames are matched with the map by their ORB features too: those where few points are followed, besides
    them keyframes, or all. All that flow has lost are in any case."""

    depth_sigma_m: Annotated[float, Positive] = 0.005
    """Standard deviation of measured depth close to the camera, meters."""
    depth_sigma_per_m2: Annotated[float, Range(at_least=0)] = 0.007
    """Its growth with the square of depth, a meter. Larger than a pixel's noise: neighbors share their errors."""
    min_depth_m: Annotated[float, Positive] = 0.3
    """Nearest depth believed, meters."""
    max_depth_m: Annotated[float, Positive] = 6.0
    """Farthest depth believed, meters."""
    disparity_sigma_px: Annotated[float, Positive] = 1.0
    """Standard deviation of the disparity of a stereo pair, pixels; it stands for the noise of depth there.

    As that of a point, as in ORB-SLAM2. A match by itself is better, but rectification is not: on a road of KITTI, with
    0.5, the tracker turned by 0.005 degrees a frame about its axis, by essential matrices of its pictures by -0.001.
    """
    far_baselines: Annotated[float, Positive] = 75.0
    """Farthest depth believed of a stereo pair whose camera file does not say, in baselines (ORB-SLAM's `ThDepth`)."""
    pixel_sigma: Annotated[float, Positive] = 1.0
    """Standard deviation of a tracked point, pixels."""
    loss_scale: Annotated[float, Positive] = 1.0
    """Scale of the robust (Cauchy) loss, in standard deviations."""
    ransac_px: Annotated[float, Positive] = 1.5
    """Reprojection error up to which a point supports a pose hypothesis while nothing moves, pixels."""
    outlier_px: Annotated[float, Positive] = 2.0
    """Reprojection error over which a point is dropped while nothing moves, pixels."""
    error_per_flow: Annotated[float, Range(at_least=0, at_most=1)] = 0.1
    """Growth of both with the median motion in the image, pixels a pixel."""
    min_correlation: Annotated[float, Range(at_least=-1, at_most=1)] = 0.8
    """Correlation from which a point looked up in a keyframe is believed."""
    min_inliers: Annotated[float, Range(at_least=4)] = 15
    """Fewest points that make a pose."""
    weak_inliers: Annotated[float, Range(at_least=4)] = 40
    """Below this many points a pose is `WEAK`."""
    min_share: Annotated[float, Share] = 0.3
    """Smallest share of the followed points that must agree on the pose."""
    detect_below: Annotated[float, Share] = 0.8
    """New points are sought when fewer than this share of `num_points` is alive."""
    keyframe_below: Annotated[float, Share] = 0.8
    """A keyframe is made when no kept one shows more than this share of its points,"""
    keyframe_followed_below: Annotated[float, Share] = 0.1
    """when less than this share of the followed points was there at the last keyframe,"""
    keyframe_points_below: Annotated[float, Share] = 0.0
    """when less than this share of `num_points` is still followed; at once if it is less than half of that,"""
    keyframe_after_s: Annotated[float, Positive] = 10.0
    """when the last one was made so many seconds ago,"""
    keyframe_weak_after_s: Annotated[float, Positive] = 0.3
    """or so many while tracking is weak or has few points."""
    keyframe_policy: Literal["as_needed", "sparing"] = "as_needed"
    """Make a keyframe as soon as there is a reason, or at the right moment after (USD-SLAM): unless points are few,"""
    keyframe_min_s: Annotated[float, Range(at_least=0)] = 0.3
    """not before so many seconds have gone since the last one, fewer the less is left in view of it,"""
    keyframe_motion: Annotated[float, Range(at_least=0)] = 0.05
    """nor before points have moved by this part of their depth, for the camera,"""
    keyframe_movable_below: Annotated[float, Share] = 0.3
    """nor while more than this share of the picture may move,"""
    keyframe_patience_s: Annotated[float, Range(at_least=0)] = 0.5
    """for which it waits so many seconds at most."""
    probation_frames: Annotated[float, Range(at_least=1)] = 8
    """Frames after which a point counts in full: what moves on its own is an outlier before that."""
    anchor_frames: Annotated[float, Range(at_least=1)] = 15
    """Frames after which the place of a point is taken anew as the one that cues to slow motion compare with."""
    restart_after: Annotated[float, Range(at_least=0)] = 15
    """Frames of loss after which tracking starts anew at the pose held."""
    max_speed_m_per_s: Annotated[float, Positive] = 5.0
    """Highest believed speed of the camera."""
    max_turn_rad_per_s: Annotated[float, Positive] = 12.0
    """Highest believed angular speed of the camera."""


@dataclass(frozen=True)
class MappingConfig(ValidatedConfig):
    """The map: what becomes of keyframes, beside tracking. Whole numbers are sizes or counts."""

    num_features: Annotated[int, Range(at_least=100, at_most=8000)] = 1000
    """ORB features of a keyframe."""
    num_levels: Annotated[int, Range(at_least=1, at_most=12)] = 8
    """Levels of the scale pyramid they are found in."""
    scale_factor: Annotated[float, Range(above=1, at_most=2)] = 1.2
    """From one of these levels to the next."""
    fast_threshold: Annotated[int, Range(at_least=1, at_most=255)] = 20
    """Contrast of a corner, gray values."""
    min_fast_threshold: Annotated[int, Range(at_least=1, at_most=255)] = 7
    """The same where there is no such corner."""
    search_px: Annotated[float, Positive] = 3.0
    """How far from where the pose puts a point of the map its feature is sought, pixels."""
    track_sigma_px: Annotated[float, Positive] = 0.3
    """Standard deviation of a tracked point in the adjustment; that of a feature is the size of its level."""
    window: Annotated[int, Range(at_least=2, at_most=32)] = 8
    """Keyframes that a local adjustment moves."""
    max_steps: Annotated[int, Range(at_least=1, at_most=100)] = 10
    """Steps of a local adjustment."""
    latency_frames: Annotated[int, Range(at_least=0, at_most=100)] = 3
    """Frames after which a deterministic run has the map of a keyframe."""


@dataclass(frozen=True)
class SemanticsConfig(ValidatedConfig):
    """Finding what may move by a network, and following it."""

    model: str | None = "yolox-nano"
    """Network: a name of `jaxslam models list`, or an ONNX file. With `null` geometry alone decides. `scene` is the
    truth of a rendered room: there only."""
    missing_model: Literal["error", "allow"] | None = None
    """What to do where a known network is not on this machine: `error` refuses to start; `allow` goes on without it,
    and every output says so. If not set, the default network alone may be missing. Presets of systems that are built
    around a network say `error`."""
    labels: tuple[str, ...] = ("person",)
    """What may move, as the network names it; in a rendered room `person` and `box`."""
    min_score: Annotated[float, Share] = 0.3
    """Detections below this score are dropped."""
    prompt_encoder: str | None = None
    """Encoder of a promptable segmenter (SAM and its family), which makes masks of the boxes that `model` finds: a name
    of `jaxslam models list`, or an ONNX file. Where `missing_model` allows it not to be on this machine, masks are made
    by depth."""
    prompt_decoder: str | None = None
    """Its decoder."""
    prompt_min_iou: Annotated[float, Share] = 0.5
    """Masks that it judges to fit less are dropped; those of boxes are then made by depth."""
    examples: str | None = None
    """YAML file or folder that shows what may move: images with masks if `model` is an in-context segmenter (SegGPT);
    boxes and points of every frame for a promptable one. `labels` do not choose among them."""
    threads: Annotated[int, Range(at_least=1, at_most=64)] = 1
    """Threads the network may use."""
    frames: Literal["every", "keyframes"] = "keyframes"
    """What the network looks at: every frame it has time for, to make masks of all, or `keyframes` alone: what may move
    then leaves keyframe and map when it is found, and frames have no mask of it (TRS-SLAM)."""
    latency_frames: Annotated[int, Range(at_least=0, at_most=100)] = 2
    """Frames after which a deterministic run has what the network found; 0 has every frame wait, live too, unless the
    network looks at keyframes alone: nobody waits for those."""
    propagate: bool = True
    """Carry masks on from frame to frame, by flow and depth; without it, one stays where it was until the next."""
    dilate_px: Annotated[int, Range(at_least=0, at_most=100)] = 3
    """How far a mask reaches beyond what was found."""


@dataclass(frozen=True)
class TrajectoryCueConfig(ValidatedConfig):
    """Whether points go from frame to frame as they would at rest (RTS-SLAM)."""

    tolerance_m: Annotated[float, Positive] = 0.02
    """Distance from there that says nothing, meters,"""
    tolerance_per_m: Annotated[float, Range(at_least=0)] = 0.04
    """and its growth with depth: three standard deviations of the difference of two depths, up to 1.5 m. With 0.02 the
    noise of depth takes 1 % of the points at rest, and rooms where people sit have 3.9 instead of 1.9 mm of error."""
    as_published: bool = False
    """Compare lengths of ways, as the paper does: wrong where the camera turns."""


@dataclass(frozen=True)
class EpipolarCueConfig(ValidatedConfig):
    """Whether points are on the lines on which they would be at rest (RTS-SLAM)."""

    limit_px: Annotated[float, Positive] = 1.0
    """Distance from the line beyond which a point moves."""
    fewest_outside: Annotated[int, Range(at_least=0)] = 30
    """With no more points outside masks, those under masks help to find the lines."""
    border_px: Annotated[float, Range(at_least=0)] = 10.0
    """Points closer to the border of the picture are not judged."""
    ransac_px: Annotated[float, Positive] = 0.5
    """Distance up to which a point supports a fundamental matrix."""
    num_hypotheses: Annotated[int, Range(at_least=8, at_most=4096)] = 32
    """Fundamental matrices tried a frame, besides that of the coarse motion of the camera."""


@dataclass(frozen=True)
class ClusterCueConfig(ValidatedConfig):
    """Whether the points of a surface are on average where the map has them (TRS-SLAM)."""

    num_regions: Annotated[int, Range(at_least=2, at_most=128)] = 24
    """Surfaces into which the depth image is divided by K-means,"""
    step_px: Annotated[int, Range(at_least=1, at_most=32)] = 4
    """of which one pixel in so many is looked at, in rows and in columns (of a pair in twice as many),"""
    num_steps: Annotated[int, Range(at_least=1, at_most=50)] = 2
    """in so many steps a frame."""
    recover_frames: Annotated[int, Range(at_least=1, at_most=1000)] = 15
    """Frames without motion after which a surface that moved counts again."""
    times_mean: Annotated[float, Positive] = 1.5
    """A surface moves if its mean error is beyond so many times that of all points."""
    least_px: Annotated[float, Range(at_least=0)] = 1.75
    """A surface with a root mean squared error below is at rest."""
    robust_px: Annotated[float, Positive] = 2.45
    """Errors beyond count hardly more; 95 % of those with a standard deviation of a pixel are below."""
    fewest: Annotated[int, Range(at_least=1)] = 6
    """Least number of points of which a mean is taken."""
    as_published: bool = False
    """Take the mean over all points, not over those that agree with the pose."""


@dataclass(frozen=True)
class MotionConfig(ValidatedConfig):
    """Whether what may move does: what masks show stays in while it stands still (USD-SLAM)."""

    enabled: bool = False
    """Judge what masks show; needs a network that looks at every frame."""
    num_objects: Annotated[int, Range(at_least=1, at_most=64)] = 16
    """Things in a frame that are judged, the largest; others are taken to move."""
    reserved: Annotated[int, Range(at_least=0, at_most=512)] = 48
    """Of `track.num_points`, how many are kept for what moves."""
    dense_cell_px: Annotated[int, Range(at_least=8, at_most=80, multiple_of=2)] = 14
    """Instead of `track.cell_px` where such things cover over half of the picture, even too."""
    sigmas: Annotated[float, Positive] = 3.0
    """A point moves if it moves more than points at rest do by so many standard deviations."""
    share: Annotated[float, Range(at_least=0, below=1)] = 0.7
    """A thing is at rest while this share of its points does not move."""
    least: Annotated[float, Range(at_least=0)] = 0.3
    """Mean motion of a thing that is none, in standard deviations of a point (`track.pixel_sigma`)."""
    fewest: Annotated[int, Range(at_least=1)] = 4
    """Least number of points that say anything of a thing."""
    still_frames: Annotated[int, Range(at_least=1)] = 3
    """Frames in which a thing must be at rest to be taken to stand still,"""
    moving_frames: Annotated[int, Range(at_least=1)] = 2
    """and in which it must move to be taken to move again."""
    as_published: bool = False
    """Motion in meters from frame to frame, its limit from mean and standard deviation; points are counted alone."""


@dataclass(frozen=True)
class OcclusionConfig(ValidatedConfig):
    """Points of the map that something passed before and that are there again count more (Occlusion SLAM)."""

    enabled: bool = False
    """Follow what passes before the points of the map."""
    weight: Annotated[float, Positive] = 3.0
    """How much such a point counts, where others count 1."""
    guard: bool = True
    """A point that is not where it should be by depth is as any other again: a thing that stood still and is carried
    away. The paper has no such guard."""


_CueName = Literal["trajectory", "epipolar", "clusters"]


@dataclass(frozen=True)
class DynamicsConfig(ValidatedConfig):
    """Finding what moves without a network."""

    new_surfaces: bool = False
    """Leave out what has come before surfaces that were seen earlier: people, doors, things that are carried."""
    cues: tuple[_CueName, ...] = ("clusters",)
    """What else tells points that move, each with a veto."""
    reach_px: Annotated[int, Range(at_least=0, at_most=100)] = 12
    """How far around a point that moves by its cues the map gets nothing, on surfaces as far away as it is."""
    balance_regions: bool = True
    """Give no surface more of a say than an even share where the pose is sought: whoever carries a large box has most
    of the points, and the room behind it most of the surfaces. They are those of `clusters`."""
    temperature: Annotated[float, Range(at_least=0)] = 0.0
    """Of the limits of cues: 0 compares and drops; above, points count less the further they are beyond."""
    trajectory: TrajectoryCueConfig = field(default_factory=TrajectoryCueConfig)
    epipolar: EpipolarCueConfig = field(default_factory=EpipolarCueConfig)
    clusters: ClusterCueConfig = field(default_factory=ClusterCueConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)


@dataclass(frozen=True)
class DenseConfig(ValidatedConfig):
    """A dense map of what stands still, colored, made of the depth of keyframes beside tracking."""

    enabled: bool = False
    """Make one."""
    voxel_m: Annotated[float, Positive] | None = None
    """Side of a voxel, each of which has one point, meters; if not set, a 300th of the farthest depth believed: 2 cm
    for cameras that measure depth."""
    cell_m: Annotated[float, Positive] | None = None
    """Side of the smallest cells of the octree, meters; if not set, two and a half voxels."""
    pixel_step: Annotated[int, Range(at_least=1, at_most=16)] = 2
    """One pixel of depth in so many is used, in rows and in columns."""
    max_points: Annotated[int, Range(at_least=1000, at_most=5_000_000)] = 400_000
    """Voxels at most. When nine tenths are taken, those found free are forgotten, and if that does not help, voxels
    become twice as large."""
    keyframe_points: Annotated[int, Range(at_least=500, at_most=500_000)] = 32_768
    """Points of one keyframe at most; voxels of one that has more are larger."""
    keyframe_below: Annotated[float, Share] = 0.9
    """A keyframe is made when no kept one shows more than this share of its points, if that is more than the tracker's
    own `track.keyframe_below`, and when all together show less than this share of the picture: what is seen in between
    is in no map."""
    memory_mb: Annotated[float, Positive] = 256.0
    """Of what is kept of keyframes, to move their points with them, megabytes. Beyond it, the oldest are forgotten:
    their points stay where they are then."""
    carve: bool = True
    """Remove what other keyframes see past: people that no mask has found, and what was carried away."""
    corrections: Annotated[int, Range(at_least=1, at_most=100)] = 1
    """Keyframes that are moved with the map for each new one, those with the largest move first."""
    key_classes: tuple[str, ...] = ()
    """Static objects to keep at full density, as the network names them: `book`, `keyboard`, `tv` (RTS-SLAM,
    Algorithm 2). They take a look of the network at each keyframe."""
    key_window: Annotated[int, Range(at_least=1, at_most=100)] = 12
    """How many frames before a keyframe show the same objects,"""
    key_frames: Annotated[int, Range(at_least=0, at_most=16)] = 3
    """and how many of those, evenly spread, are used."""
    key_points: Annotated[int, Range(at_least=1000, at_most=5_000_000)] = 200_000
    """Points of key objects at most, in voxels of a quarter of the side; as `max_points`."""


@dataclass(frozen=True)
class RunConfig(ValidatedConfig):
    """How a recording or a live stream is run."""

    deterministic: bool = True
    """Run every module in turn, so that two runs give the same bytes; `False` gives each its thread."""
    realtime: bool = False
    """Feed a recording at the rate it was taken at, each module in its thread whatever `deterministic` says: frames for
    which there is no time are dropped."""
    seed: Annotated[int, Range(at_least=0, at_most=2**32 - 1)] = 0
    """Seed of every random choice."""
    on_loss: Literal["hold", "predict", "submap"] = "submap"
    """What to do while lost, until the place is recognized: `hold` the last pose, `predict` it with constant velocity
    for a second, or hold it and after `track.restart_after` frames start a new `submap` there, which becomes one with
    the map when a place of it is recognized."""
    prefetch_frames: Annotated[int, Range(at_least=1, at_most=64)] = 4
    """Frames of a recording decoded ahead of the tracker."""

    @property
    def in_turn(self) -> bool:
        """Whether every module runs in the thread of the tracker, on a fixed schedule."""
        return self.deterministic and not self.realtime


@dataclass(frozen=True)
class Config(ValidatedConfig):
    """Everything that can be set."""

    track: TrackConfig = field(default_factory=TrackConfig)
    run: RunConfig = field(default_factory=RunConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    semantics: SemanticsConfig = field(default_factory=SemanticsConfig)
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)


_RENAMED = {
    "dynamics.even_votes": "dynamics.balance_regions",
    "dynamics.newcomers": "dynamics.new_surfaces",
    "track.hold_to_map": "track.match_map",
    "track.keyframe_choice": "track.keyframe_policy",
    "track.keyframe_least_s": "track.keyframe_min_s",
    "track.num_recalled": "track.num_reloaded",
    "track.refill_below": "track.detect_below",
}
"""Earlier names of settings, and the present name of each."""


def load_config(preset: str = "default", file: str | Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """The settings of a run.

    Args:
        preset: A name in `presets()`.
        file: A YAML file of differences; it beats the preset, and may itself `inherit:` another preset.
        overrides: `key=value` with dotted keys, such as `track.num_points=400`; they beat the file.

    Raises:
        ConfigError: If a preset or file is missing, a key is unknown (at any depth), or a value has the wrong
            type or is out of range. The message names the place, the key, what was expected and what came.
    """
    layers = _preset_layers(preset)
    if file is not None:
        layers += _file_layers(Path(file))
    layers.append(("override", _parsed_overrides(overrides)))
    config = Config()
    for origin, changes in layers:
        try:
            config = updated(config, changes)
        except ConfigError as error:
            raise ConfigError(f"{origin}: {error}") from None
    return config


def to_yaml(config: ValidatedConfig) -> str:
    """Every setting as YAML; `load_config(file=...)` reads it back to an equal `Config`."""
    return yaml.safe_dump(_plain(dataclasses.asdict(config)), sort_keys=False)


def updated(section: _Section, changes: Mapping[str, Any], path: str = "") -> _Section:
    """`section` with `changes` made to it, nested mappings changing nested sections.

    Args:
        section: An instance of a frozen dataclass derived from `ValidatedConfig`.
        changes: Values by field name.
        path: Dotted name of the section, for messages.

    Raises:
        ConfigError: If a key is unknown, or a value has the wrong type or is out of range.
    """
    hints = field_hints(type(section))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        name = f"{path}.{key}" if path else str(key)
        if name in _RENAMED:
            raise ConfigError(f"{name}: renamed, use {_RENAMED[name]}")
        if key not in hints:
            raise ConfigError(f"{one_line(name, 80)}: unknown key{nearest(str(key), hints)}")
        values[key] = _updated_value(hints[key], getattr(section, key), value, name)
    return dataclasses.replace(section, **values)  # type: ignore[type-var]


def presets() -> list[str]:
    """The names of the presets that come with jaxslam."""
    return sorted(path.stem for path in (configs_dir() / "presets").glob("*.yaml"))


def configs_dir() -> Path:
    """The folder of cameras, presets and benchmarks: in an installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_configs", package.parent / "configs"):
        if folder.is_dir():
            return folder
    raise ConfigError(f"configs: expected the folder _configs in {package} or configs beside it, got neither")


def _updated_value(hint: Any, current: Any, value: object, name: str) -> Any:
    section = section_of(hint)
    if section is None:
        return checked_value(hint, value, name)
    if isinstance(value, Mapping):
        return updated(section() if current is None else current, value, name)
    if value is None and current is not None:  # a heading with every line under it commented out
        return current
    return checked_value(hint, value, name)


def _preset_layers(name: str, heirs: tuple[str, ...] = ()) -> list[tuple[str, dict[str, Any]]]:
    if name in heirs:
        raise ConfigError(f"preset {heirs[0]}: inherits itself: {' -> '.join((*heirs, name))}")
    if name not in presets():
        by = f"preset {heirs[-1]}: inherit: " if heirs else "preset: "
        raise ConfigError(f"{by}expected a known preset, got '{name:.24}'{nearest(name, presets())}")
    return _file_layers(configs_dir() / "presets" / f"{name}.yaml", (*heirs, name))


def _file_layers(path: Path, heirs: tuple[str, ...] = ()) -> list[tuple[str, dict[str, Any]]]:
    changes = read_mapping(path, ConfigError)
    parent = changes.pop("inherit", None)
    if parent is None:
        return [(str(path), changes)]
    if not isinstance(parent, str):
        raise ConfigError(f"{path}: inherit: expected the name of a preset, got {parent!r}")
    return [*_preset_layers(parent, heirs), (str(path), changes)]


def _parsed_overrides(overrides: Sequence[str]) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"override: expected key=value such as track.num_points=400, got '{override}'")
        value = parse_yaml(text, f"override {key}", ConfigError)
        *sections, last = key.strip().split(".")
        place = changes
        for section in sections:
            inner = place.setdefault(section, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"override: '{override}' needs a section, but '{section}' is set to {inner!r}")
            place = inner
        place[last] = value
    return changes


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
