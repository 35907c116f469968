"""Settings: frozen dataclasses that hold the only defaults, to which `loading.py` applies differences.

Field types carry their accepted range; a value out of range is a `ConfigError` however the section is built.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from jaxslam.config.cue_sections import (
    ClusterCueConfig,
    EpipolarCueConfig,
    LearnedCueConfig,
    MotionConfig,
    OcclusionConfig,
    TrajectoryCueConfig,
)
from jaxslam.config.validation import Positive, Range, Share, ValidatedConfig


@dataclass(frozen=True)
class TrackConfig(ValidatedConfig):
    """Settings of the tracker, which processes every frame. Integers are array sizes: changing one recompiles."""

    num_points: Annotated[int, Range(at_least=32, at_most=4096)] = 512
    """Number of points tracked from frame to frame."""
    num_levels: Annotated[int, Range(at_least=2, at_most=6)] = 4
    """Number of image pyramid levels; one more level follows motions twice as fast."""
    num_keyframes: Annotated[int, Range(at_least=1, at_most=64)] = 12
    """Number of latest keyframes kept for matching their points in the current frame."""
    num_reloaded: Annotated[int, Range(at_least=0, at_most=64)] = 4
    """Number of further keyframes, reloaded from the map where the camera returns, that are kept for matching."""
    num_sources: Annotated[int, Range(at_least=0, at_most=8)] = 2
    """Number of the kept keyframes that are matched with each frame; 0 tracks from frame to frame only."""
    points_per_source: Annotated[int, Range(at_least=16, at_most=2048)] = 160
    """Number of points matched from each of these keyframes."""
    num_hypotheses: Annotated[int, Range(at_least=16, at_most=1024)] = 64
    """Number of RANSAC pose hypotheses per frame."""
    cell_px: Annotated[int, Range(at_least=8, at_most=80, multiple_of=2)] = 20
    """Side of the grid cells that each receive at most one new corner, pixels. It must be even."""
    new_points: Literal["always", "keyframes"] = "always"
    """Frames in which new points are detected where there are few: all frames, or keyframes only."""
    match_map: Literal["weak", "keyframes", "always"] = "weak"
    """Frames that are also matched with the map by ORB features: frames with few tracked points (`weak`), keyframes
    too, or all frames. Frames that optical flow has lost are matched in any case, and so are those in which hardly any
    point agrees of the keyframes that show the view."""

    depth_sigma_m: Annotated[float, Positive] = 0.005
    """Standard deviation of measured depth close to the camera, meters."""
    depth_sigma_per_m2: Annotated[float, Range(at_least=0)] = 0.007
    """Growth of that standard deviation with the square of depth, 1 / m. It is larger than the noise of a single pixel
    because neighboring pixels share their errors."""
    min_depth_m: Annotated[float, Positive] = 0.3
    """Smallest valid depth of a depth sensor, meters."""
    max_depth_m: Annotated[float, Positive] = 6.0
    """Largest valid depth of a depth sensor, meters."""
    disparity_sigma_px: Annotated[float, Positive] = 1.0
    """Standard deviation of the disparity of a stereo pair, pixels. It replaces the depth noise settings there.

    It is the same as for a point, as in ORB-SLAM2. A match on its own is more precise, but rectification is not: on a
    KITTI road, with 0.5, the tracker turned by 0.005 degrees per frame about its axis; by essential matrices of its
    images, it turned by -0.001 degrees.
    """
    near_baselines: Annotated[float, Positive] = 3.0
    """Smallest valid depth of a stereo pair, in baselines. It replaces `min_depth_m` there."""
    far_baselines: Annotated[float, Positive] = 75.0
    """Largest valid depth of a stereo pair, in baselines (ORB-SLAM's `ThDepth`), if the camera file gives none. It
    replaces `max_depth_m` there."""
    pixel_sigma: Annotated[float, Positive] = 1.0
    """Standard deviation of a tracked point, pixels."""
    loss_scale: Annotated[float, Positive] = 1.0
    """Scale of the robust (Cauchy) loss, in standard deviations."""
    ransac_px: Annotated[float, Positive] = 1.5
    """Reprojection error up to which a point supports a pose hypothesis while the image is still, pixels."""
    outlier_px: Annotated[float, Positive] = 2.0
    """Reprojection error above which a point is dropped while the image is still, pixels."""
    error_per_flow: Annotated[float, Range(at_least=0, at_most=1)] = 0.1
    """Growth of `ransac_px` and `outlier_px` with the median optical flow of the frame, pixels per pixel."""
    min_correlation: Annotated[float, Range(at_least=-1, at_most=1)] = 0.8
    """Minimum correlation of a point matched from a keyframe."""
    min_inliers: Annotated[float, Range(at_least=4)] = 15
    """Minimum number of inliers of a valid pose."""
    weak_inliers: Annotated[float, Range(at_least=4)] = 40
    """Number of points that agree with a pose, those of keyframes included, below which its status is `WEAK`. After a
    lost frame, fewer tracked ones are no pose at all."""
    gyro: bool = True
    """Use the angular rates of an IMU, where the frames have any, to tell how the camera turns."""
    min_share: Annotated[float, Share] = 0.3
    """Minimum share of the tracked points that must agree on the pose."""
    detect_below: Annotated[float, Share] = 0.8
    """New points are detected when less than this share of `num_points` is alive."""
    keyframe_below: Annotated[float, Share] = 0.8
    """A keyframe is made when less than this share of the points of every keyframe that the tracker holds is in view,
    unless `keyframe_views` keyframes show the view."""
    keyframe_followed_below: Annotated[float, Share] = 0.1
    """A keyframe is made when less than this share of the tracked points already existed at the last keyframe, unless
    `keyframe_views` keyframes show the view or many of their points are found."""
    keyframe_views: Annotated[int, Range(at_least=1)] = 4
    """Number of keyframes with `keyframe_below` of their points in view from which on another one is no news; four
    times as many where hardly a point of them is found, as in a crowd or in another light."""
    keyframe_points_below: Annotated[float, Share] = 0.0
    """A keyframe is made when less than this share of `num_points` is still tracked and `keyframe_weak_after_s` has
    passed; below half of the share, it is made at once."""
    keyframe_weak_after_s: Annotated[float, Positive] = 0.3
    """While tracking is weak or has few points, a keyframe is made when the last one is older than this, seconds; while
    it is weak, only if fewer than `keyframe_views` keyframes show the view."""
    keyframe_policy: Literal["as_needed", "sparing"] = "as_needed"
    """When to make a keyframe for which there is a reason: at once (`as_needed`), or at the right moment after that
    (`sparing`, USD-SLAM). Few points or weak tracking never wait; the next four settings apply to `sparing` only."""
    keyframe_min_s: Annotated[float, Range(at_least=0)] = 0.3
    """Minimum time since the last keyframe, seconds. It is shorter the less of the last keyframe is still in view."""
    keyframe_motion: Annotated[float, Range(at_least=0)] = 0.05
    """Minimum motion of the points in camera axes since the last keyframe, as a share of their depth."""
    keyframe_movable_below: Annotated[float, Share] = 0.3
    """Share of the image covered by movable objects above which a keyframe waits."""
    keyframe_patience_s: Annotated[float, Range(at_least=0)] = 0.5
    """Maximum time that a keyframe waits because movable objects cover too much of the image, seconds."""
    probation_frames: Annotated[float, Range(at_least=1)] = 8
    """Number of frames after which a new point has its full weight. A point that moves on its own is an outlier
    before that."""
    anchor_frames: Annotated[float, Range(at_least=1)] = 15
    """Number of frames after which the anchor position of a point, with which cues to slow motion compare, is measured
    again."""
    restart_after: Annotated[float, Range(at_least=0)] = 15
    """Number of lost frames after which tracking starts again at the last pose."""
    max_speed_m_per_s: Annotated[float, Positive] | None = None
    """Maximum plausible speed of the camera, meters per second. If not set, the largest valid depth in a second: 6 m/s
    for a depth sensor, 40 m/s for a pair with a baseline of 0.54 m."""
    max_turn_rad_per_s: Annotated[float, Positive] = 12.0
    """Maximum plausible angular speed of the camera, radians per second."""


@dataclass(frozen=True)
class MappingConfig(ValidatedConfig):
    """Settings of the map, which is built from keyframes beside tracking. Integers are sizes or counts."""

    num_features: Annotated[int, Range(at_least=100, at_most=8000)] = 1000
    """Number of ORB features per keyframe."""
    num_levels: Annotated[int, Range(at_least=1, at_most=12)] = 8
    """Number of levels of the scale pyramid in which features are detected."""
    scale_factor: Annotated[float, Range(above=1, at_most=2)] = 1.2
    """Scale ratio between successive pyramid levels."""
    fast_threshold: Annotated[int, Range(at_least=1, at_most=255)] = 20
    """Contrast threshold of FAST corners, gray values."""
    min_fast_threshold: Annotated[int, Range(at_least=1, at_most=255)] = 7
    """Contrast threshold where no corner passes `fast_threshold`, gray values."""
    search_px: Annotated[float, Positive] = 3.0
    """Radius around the projection of a map point in which its feature is searched, pixels."""
    track_sigma_px: Annotated[float, Positive] = 0.3
    """Standard deviation of a tracked point in bundle adjustment, pixels. That of a feature is the size of its pyramid
    level."""
    window: Annotated[int, Range(at_least=2, at_most=32)] = 8
    """Number of keyframes whose poses local bundle adjustment optimizes."""
    max_steps: Annotated[int, Range(at_least=1, at_most=100)] = 10
    """Maximum number of iterations of local bundle adjustment."""
    latency_frames: Annotated[int, Range(at_least=0, at_most=100)] = 3
    """Number of frames after which a deterministic run has the map that includes a keyframe."""
    max_mb: Annotated[float, Positive] | None = None
    """Memory that the map may take, megabytes. Beyond it keyframes leave: first those whose points others show, then
    the farthest from the camera. Without it, the map grows with the space that it shows."""
    global_adjustment: bool = True
    """Whether to adjust all keyframes and points of the map together after a loop, beside tracking (global bundle
    adjustment). A deterministic run has the result after ten times `latency_frames`. Without it, only those around the
    loop are adjusted, window by window."""


@dataclass(frozen=True)
class SemanticsConfig(ValidatedConfig):
    """Settings of the network that segments movable objects, and of the propagation of its masks."""

    model: str | None = "yolox-nano"
    """Network: a name from `jaxslam models list`, or an ONNX file. With `null`, geometry alone decides. `scene` is the
    ground truth of a rendered room and works only there."""
    missing_model: Literal["error", "allow"] | None = None
    """What to do if a known network is not on this machine: `error` refuses to start; `allow` runs without it, and
    every output says so. If not set, only the default network may be missing. Presets of systems that are built around
    a network say `error`."""
    labels: tuple[str, ...] = ("person",)
    """Classes of movable objects: names of COCO, of PASCAL VOC or of the network's own, and groups of classes.
    `people`, `vehicles` and `animals` move by themselves; `furniture`, `bags` and `handheld` do not, which matters to
    `dynamics.motion`. In a rendered room, also `box`."""
    min_score: Annotated[float, Share] = 0.3
    """Detections below this score are dropped."""
    prompt_encoder: str | None = None
    """Encoder of a promptable segmenter (SAM and its family), which turns the boxes that `model` detects into masks: a
    name from `jaxslam models list`, or an ONNX file. If it is missing and `missing_model` allows that, masks are made
    from depth."""
    prompt_decoder: str | None = None
    """Decoder of the promptable segmenter, named in the same way as `prompt_encoder`."""
    prompt_min_iou: Annotated[float, Share] = 0.5
    """Masks for which the promptable segmenter predicts a smaller IoU are dropped; the masks of boxes are then made
    from depth."""
    examples: str | None = None
    """YAML file or folder that shows the movable objects: images with masks if `model` is an in-context segmenter
    (SegGPT), or boxes and points of every frame for a promptable segmenter. `labels` do not filter them."""
    threads: Annotated[int, Range(at_least=1, at_most=64)] | None = None
    """Number of threads the network may use; as many as `run.threads` if not set."""
    frames: Literal["every", "keyframes"] = "keyframes"
    """Frames that the network processes. `every` is each frame it has time for, and makes masks for all frames. With
    `keyframes`, movable objects are removed from the keyframe and the map once they are detected, and other frames have
    no mask of them (TRS-SLAM)."""
    latency_frames: Annotated[int, Range(at_least=0, at_most=100)] = 2
    """Number of frames after which a deterministic run has the result of the network. With 0 every frame waits for its
    own result, in live runs too, unless the network processes keyframes only: nothing waits for those."""
    propagate: bool = True
    """Whether to propagate masks from frame to frame by flow and depth. Without it, a mask stays where it was until the
    next one."""
    mask_corners: Literal["shi-tomasi", "fast"] = "shi-tomasi"
    """Corners at which a mask is followed while it is propagated: those of Shi and Tomasi, or FAST corners, as in
    NGD-SLAM."""
    dilate_px: Annotated[int, Range(at_least=0, at_most=100)] = 3
    """Dilation of the detected masks, pixels."""


_CueName = Literal["trajectory", "epipolar", "clusters", "learned"]


@dataclass(frozen=True)
class DynamicsConfig(ValidatedConfig):
    """Settings for the rejection of moving points without a network."""

    new_surfaces: bool = False
    """Whether to mask new surfaces, which appeared in front of surfaces that were seen earlier: people, doors, carried
    objects."""
    cues: tuple[_CueName, ...] = ("clusters",)
    """Geometric cues that classify points as moving; each of them can reject a point."""
    judge_masked: bool = False
    """Whether points under masks are classified by `cues`, as in RTS-SLAM: those that a cue finds static and none finds
    moving are used. Otherwise, all points under masks are left out."""
    reach_px: Annotated[int, Range(at_least=0, at_most=100)] = 12
    """Radius around a point that its cues classify as moving, pixels, within which surfaces at the same depth are not
    added to the map."""
    balance_regions: bool = True
    """Whether to limit every surface to an even share of the votes in pose estimation: a person with a large box has
    most of the points, and the room behind them most of the surfaces. The surfaces are those of `clusters`."""
    temperature: Annotated[float, Range(at_least=0)] = 0.0
    """Softness of the limits of cues: with 0 a point beyond the limit is dropped; above 0 its weight falls the further
    it is beyond."""
    trajectory: TrajectoryCueConfig = field(default_factory=TrajectoryCueConfig)
    """Settings of the trajectory cue."""
    epipolar: EpipolarCueConfig = field(default_factory=EpipolarCueConfig)
    """Settings of the epipolar cue."""
    clusters: ClusterCueConfig = field(default_factory=ClusterCueConfig)
    """Settings of the cluster cue."""
    learned: LearnedCueConfig = field(default_factory=LearnedCueConfig)
    """Settings of the learned cue. Its surfaces are those of `clusters`."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    """Settings of the motion state of masked objects."""
    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)
    """Settings of occlusion weighting."""


@dataclass(frozen=True)
class DenseConfig(ValidatedConfig):
    """Settings of the dense colored map of the static scene, built from keyframe depth beside tracking."""

    enabled: bool = False
    """Whether to build a dense map."""
    voxel_m: Annotated[float, Positive] | None = None
    """Side of a voxel, meters; each voxel holds one point. If not set, a 300th of the largest valid depth: 2 cm for
    cameras that measure depth."""
    cell_m: Annotated[float, Positive] | None = None
    """Side of the smallest octree cells, meters. If not set, two and a half voxels."""
    pixel_step: Annotated[int, Range(at_least=1, at_most=16)] = 2
    """Sampling step of depth images, pixels: one pixel in this many is used, in rows and in columns."""
    max_points: Annotated[int, Range(at_least=1000, at_most=5_000_000)] = 400_000
    """Maximum number of voxels. When nine tenths are in use, voxels found free are discarded, and if that is not
    enough, voxels become twice as large."""
    keyframe_points: Annotated[int, Range(at_least=500, at_most=500_000)] = 32_768
    """Maximum number of points per keyframe; a keyframe that has more gets larger voxels."""
    keyframe_below: Annotated[float, Share] = 0.9
    """A keyframe is made when the frame shows less than this share of the points of every kept keyframe, if this is
    more than the tracker's own `track.keyframe_below`, and also when all keyframes together show less than this share
    of the image: surfaces seen only between keyframes would be missing from the map."""
    memory_mb: Annotated[float, Positive] = 256.0
    """Maximum memory for keyframe data that lets points move with their keyframes, megabytes. Beyond it, the data of
    the oldest keyframes is discarded, and their points stay where they are then."""
    carve: bool = True
    """Whether to remove points that other keyframes see through: people that no mask covered, and objects that were
    carried away."""
    corrections: Annotated[int, Range(at_least=1, at_most=100)] = 1
    """Number of keyframes moved with the map for each new keyframe, largest motion first."""
    key_classes: tuple[str, ...] = ()
    """Static objects to keep at full density, as the network names them: `book`, `keyboard`, `tv` (RTS-SLAM, Algorithm
    2). They cost one network inference per keyframe."""
    key_window: Annotated[int, Range(at_least=1, at_most=100)] = 12
    """Number of frames before a keyframe that are searched for further views of the same objects."""
    key_frames: Annotated[int, Range(at_least=0, at_most=16)] = 3
    """Number of those frames that are used, evenly spread."""
    key_points: Annotated[int, Range(at_least=1000, at_most=5_000_000)] = 200_000
    """Maximum number of voxels of key objects, with a quarter of the side; it works as `max_points` does."""


@dataclass(frozen=True)
class RunConfig(ValidatedConfig):
    """Settings of how a recording or a live stream is run."""

    deterministic: bool = True
    """Whether to run all modules in turn, so that two runs give the same bytes; `False` gives each its own thread."""
    realtime: bool = False
    """Whether to play a recording back at its original rate, with each module in its thread whatever `deterministic`
    says. Frames for which there is no time are dropped."""
    seed: Annotated[int, Range(at_least=0, at_most=2**32 - 1)] = 0
    """Seed of every random choice."""
    on_loss: Literal["hold", "predict", "submap"] = "submap"
    """What to do while lost, until the place is recognized: `hold` the last pose, `predict` it with constant velocity
    for a second, or hold it and after `track.restart_after` frames start a new `submap` there, which is merged with the
    map when one of its places is recognized."""
    prefetch_frames: Annotated[int, Range(at_least=1, at_most=64)] = 4
    """Number of frames of a recording decoded ahead of the tracker."""
    threads: Annotated[int, Range(at_least=1, at_most=64)] = 1
    """Number of threads that XLA, OpenCV, BLAS and the network may each use. XLA takes it at the first array of the
    process, and `NPROC` in the environment outranks it there. One is fastest for the tracker."""

    @property
    def in_turn(self) -> bool:
        """Whether all modules run in the tracker's thread, on a fixed schedule."""
        return self.deterministic and not self.realtime


@dataclass(frozen=True)
class Config(ValidatedConfig):
    """All settings."""

    track: TrackConfig = field(default_factory=TrackConfig)
    """Settings of the tracker."""
    run: RunConfig = field(default_factory=RunConfig)
    """Settings of how a recording or a live stream is run."""
    mapping: MappingConfig = field(default_factory=MappingConfig)
    """Settings of the map."""
    semantics: SemanticsConfig = field(default_factory=SemanticsConfig)
    """Settings of the network and of mask propagation."""
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    """Settings for the rejection of moving points without a network."""
    dense: DenseConfig = field(default_factory=DenseConfig)
    """Settings of the dense map."""
