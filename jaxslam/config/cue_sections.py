"""Settings of the cues that tell dynamic points from static ones, one section per cue."""

from dataclasses import dataclass
from typing import Annotated

from jaxslam.config.validation import Positive, Range, ValidatedConfig


@dataclass(frozen=True)
class TrajectoryCueConfig(ValidatedConfig):
    """Trajectory cue: does a point move from frame to frame as a static point would (RTS-SLAM)?"""

    tolerance_m: Annotated[float, Positive] = 0.02
    """Distance from the expected static position that is tolerated close to the camera, meters."""
    tolerance_per_m: Annotated[float, Range(at_least=0)] = 0.04
    """Growth of the tolerance with depth, meters per meter: together with `tolerance_m`, three standard deviations of
    the difference of two depths, up to 1.5 m. With 0.02, depth noise removes 1 % of the static points, and rooms where
    people sit have an error of 3.9 mm instead of 1.9 mm."""
    as_published: bool = False
    """Whether to compare path lengths, as the paper does; this is wrong where the camera turns."""


@dataclass(frozen=True)
class EpipolarCueConfig(ValidatedConfig):
    """Epipolar cue: does a point lie on the epipolar line on which a static point would be (RTS-SLAM)?"""

    limit_px: Annotated[float, Positive] = 1.0
    """Distance from the epipolar line beyond which a point is classified as moving, pixels."""
    fewest_outside: Annotated[int, Range(at_least=0)] = 30
    """Number of points outside masks up to which points under masks also vote for the epipolar geometry."""
    border_px: Annotated[float, Range(at_least=0)] = 10.0
    """Points closer than this to the image border are not classified, pixels."""
    ransac_px: Annotated[float, Positive] = 0.5
    """Distance up to which a point supports a fundamental matrix, pixels."""
    num_hypotheses: Annotated[int, Range(at_least=8, at_most=4096)] = 32
    """Number of fundamental matrices tried per frame, besides the one from the coarse camera motion."""


@dataclass(frozen=True)
class ClusterCueConfig(ValidatedConfig):
    """Cluster cue: are the points of a surface, on average, where the map has them (TRS-SLAM)?"""

    num_regions: Annotated[int, Range(at_least=2, at_most=128)] = 24
    """Number of surfaces into which K-means divides the depth image."""
    step_px: Annotated[int, Range(at_least=1, at_most=32)] = 4
    """Sampling step of the depth image for K-means, pixels: one pixel in this many is used, in rows and in columns. For
    a stereo pair the step is twice as large."""
    num_steps: Annotated[int, Range(at_least=1, at_most=50)] = 2
    """Number of K-means iterations per frame."""
    recover_frames: Annotated[int, Range(at_least=1, at_most=1000)] = 15
    """Number of frames without motion after which a surface that moved counts as static again."""
    times_mean: Annotated[float, Positive] = 1.5
    """A surface is classified as moving if its mean error exceeds the mean error of all points by this factor."""
    least_px: Annotated[float, Range(at_least=0)] = 1.75
    """A surface whose root mean squared error is below this is static, pixels."""
    robust_px: Annotated[float, Positive] = 2.45
    """Scale of the robust loss, pixels: larger errors add hardly any more. 95 % of errors with a standard deviation of
    one pixel are below the default."""
    fewest: Annotated[int, Range(at_least=1)] = 6
    """Minimum number of points from which a mean is computed."""
    as_published: bool = False
    """Whether the mean is over all points, instead of only those that agree with the pose."""


@dataclass(frozen=True)
class LearnedCueConfig(ValidatedConfig):
    """Learned cue: does a small network, which sees all that is known of a point and its surface, say that it moves?"""

    weights: str | None = None
    """File with the weights of the network, as `jaxslam learn weights` writes it; the one that comes with jaxslam if
    not set."""
    recover_frames: Annotated[int, Range(at_least=1, at_most=1000)] = 2
    """Number of frames without motion after which a surface that moved counts as static again, without other cues. The
    network sees itself how a surface moved before: with 15 as for `clusters`, 1.66 % of the points of 28 rendered
    scenes were wrong, where its verdicts alone were wrong for 0.78 %."""


@dataclass(frozen=True)
class MotionConfig(ValidatedConfig):
    """Object motion state: a masked movable object is kept in while it stands still (USD-SLAM)."""

    enabled: bool = False
    """Whether to classify masked objects as moving or at rest. This needs a network that processes every frame."""
    num_objects: Annotated[int, Range(at_least=1, at_most=64)] = 16
    """Maximum number of objects classified per frame, largest first; all others are assumed to move."""
    reserved: Annotated[int, Range(at_least=0, at_most=512)] = 48
    """Number of the `track.num_points` slots reserved for points on moving objects."""
    dense_cell_px: Annotated[int, Range(at_least=8, at_most=80, multiple_of=2)] = 14
    """Grid cell side, pixels, that replaces `track.cell_px` where movable objects cover more than half of the image. It
    must be even."""
    sigmas: Annotated[float, Positive] = 3.0
    """A point is moving if its motion exceeds that of static points by this many standard deviations."""
    share: Annotated[float, Range(at_least=0, below=1)] = 0.7
    """An object is at rest while at least this share of its points does not move."""
    least: Annotated[float, Range(at_least=0)] = 0.3
    """Mean motion of an object that still counts as none, in standard deviations of a point (`track.pixel_sigma`)."""
    fewest: Annotated[int, Range(at_least=1)] = 4
    """Minimum number of points on an object from which it is classified."""
    still_frames: Annotated[int, Range(at_least=1)] = 3
    """Number of frames for which a moving object must be at rest before it counts as static."""
    moving_frames: Annotated[int, Range(at_least=1)] = 2
    """Number of frames for which a static object must move before it counts as moving again."""
    as_published: bool = False
    """Whether to follow the paper: motion is measured in meters from frame to frame, its limit comes from the mean and
    the standard deviation, and an object is classified by a count of its points alone."""


@dataclass(frozen=True)
class OcclusionConfig(ValidatedConfig):
    """Occlusion weighting: map points that reappear behind a passing object count more (Occlusion SLAM)."""

    enabled: bool = False
    """Whether to track which map points are occluded by a passing object."""
    weight: Annotated[float, Positive] = 3.0
    """Weight of a point that reappeared after an occlusion; all other points have weight 1."""
    guard: bool = True
    """Whether a point returns to weight 1 when measured depth shows that it is no longer where it should be, as when an
    object that stood still is carried away. The paper has no such guard."""
