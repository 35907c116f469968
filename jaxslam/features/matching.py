"""Match ORB features with those of another image, and with map points projected by a pose."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64, Integer, UInt8, UInt16, UInt64

from jaxslam.features.orb import DEFAULT_PLAN, FeaturePlan, Features
from jaxslam.features.sorting import sorted_together

FAR = 100
"""Maximum Hamming distance where a pose supports a match as well: `TH_HIGH` of ORB-SLAM (Mur-Artal et al. 2015)."""
NEAR = 50
"""Maximum Hamming distance where only descriptors support a match: `TH_LOW` of ORB-SLAM."""
_BITS = 256
_TURN_BINS = 30
_TURN_PEAKS = 3
_MIN_PEAK = 0.1
"""Bins of the rotation histogram between two images, how many of the fullest are kept, and their minimum size relative
to the fullest: `HISTO_LENGTH` and `ComputeThreeMaxima` of ORB-SLAM."""
_OCTAVES_APART = 1
_FARTHEST = 1e5
"""Pixels, and bands of them, beyond which features are looked for as if they were there: no image is as large."""
_SLACK_PX = 1e-2
"""What numbers of up to 1e13, of eight images, may be off by rounding, pixels, in excess."""
_ROWS = 32
"""Rows of a distance table computed at a time, so that they stay in the cache."""


def hamming(a: UInt8[np.ndarray, "n 32"], b: UInt8[np.ndarray, "m 32"]) -> UInt16[np.ndarray, "n m"]:
    """Compute the Hamming distance of every descriptor of `a` to every one of `b`.

    4.6 ms for 1000 x 1000 on one core; `cv2.BFMatcher` takes 5.7 ms for the two best alone, and a matrix product of
    bits as float32 3.9 ms.
    """
    words_a, words_b = _words(a), _words(b)
    distance = np.zeros((len(a), len(b)), np.uint16)
    for start in range(0, len(a), _ROWS):
        part = slice(start, start + _ROWS)
        for word_a, word_b in zip(words_a, words_b, strict=True):
            distance[part] += np.bitwise_count(word_a[part, None] ^ word_b[None, :])
    return distance


def hamming_pairs(a: UInt8[np.ndarray, "n 32"], b: UInt8[np.ndarray, "n 32"]) -> UInt16[np.ndarray, " n"]:
    """Compute the Hamming distance of each descriptor of `a` to the corresponding one of `b`."""
    return np.bitwise_count(_words(a) ^ _words(b)).sum(axis=0, dtype=np.uint16)


def match_descriptors(
    a: Features, b: Features, *, max_distance: int = NEAR, ratio: float = 0.75, check_turn: bool = True
) -> Int64[np.ndarray, "2 k"]:
    """Match the features of two images by their descriptors alone.

    Args:
        a: Features of the first image.
        b: Features of the second image.
        max_distance: Maximum Hamming distance of a match, in bits.
        ratio: The distance of the best match of a feature of `a` must be below this share of the second best.
        check_turn: Whether to drop matches whose patch rotation differs from that of most matches.

    Returns:
        `(2, k)` index in `a` and in `b` of every match; the two features are each other's best. Ascending in `a`.
    """
    if not len(a.descriptor) or not len(b.descriptor):
        return np.zeros((2, 0), np.int64)
    distance = hamming(a.descriptor, b.descriptor)
    best, row = distance.argmin(axis=1), np.arange(len(a.descriptor))
    least = distance[row, best]
    good = least <= max_distance
    if len(b.descriptor) > 1:
        distance[row, best] = _BITS + 1  # what is left is the second best: a tenth of the time of a partition
        good &= least < ratio * distance.min(axis=1)
        distance[row, best] = least
    row, best = row[good], best[good]
    pairs = np.stack([row, best])[:, distance[:, best].argmin(axis=0) == row]
    return pairs[:, same_turn(b.angle[pairs[1]] - a.angle[pairs[0]])] if check_turn else pairs


def same_turn(turn: Float32[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return which rotation angles, in radians, fall into the fullest histogram bins."""
    bins = np.round(turn * (_TURN_BINS / (2 * np.pi))).astype(np.int64) % _TURN_BINS
    counts = np.bincount(bins, minlength=_TURN_BINS)
    fullest = np.argsort(-counts, kind="stable")[:_TURN_PEAKS]
    return np.isin(bins, fullest[counts[fullest] >= _MIN_PEAK * counts[fullest[0]]])


def predicted_octave(
    octave: Integer[np.ndarray, " n"],
    depth_then: Float[np.ndarray, " n"],
    depth_now: Float[np.ndarray, " n"],
    plan: FeaturePlan = DEFAULT_PLAN,
) -> Int64[np.ndarray, " n"]:
    """Predict the octave of features seen from another distance: image size is inversely proportional to depth.

    Args:
        octave: `(n,)` octaves at which they were detected.
        depth_then: `(n,)` their depths there, in meters, positive.
        depth_now: `(n,)` their depths in the image to search, in meters, positive.
        plan: Settings of feature extraction.
    """
    change = np.log(depth_then / depth_now) / np.log(plan.scale_factor)
    return np.clip(np.round(octave + change), 0, plan.num_levels - 1).astype(np.int64)


def match_by_projection(
    predicted_uv: Float[np.ndarray, "2 p"],
    octave: Integer[np.ndarray, " p"],
    descriptor: UInt8[np.ndarray, "p 32"],
    features: Features,
    *,
    radius_px: float,
    max_distance: int = FAR,
    ratio: float = 0.9,
    plan: FeaturePlan = DEFAULT_PLAN,
    images: tuple[Int[np.ndarray, " p"], Int[np.ndarray, " n"]] | None = None,
) -> Int64[np.ndarray, "2 k"]:
    """Match map points with features near their predicted pixels.

    Args:
        predicted_uv: `(2, p)` predicted pixels of the ideal camera, as in `Features.uv`. A point whose prediction is
            not finite is not searched.
        octave: `(p,)` octaves from `predicted_octave`; features of neighboring octaves are considered too.
        descriptor: Descriptors of the points.
        features: Features of the image, or those of several images one after the other.
        radius_px: Search radius at octave 0, in pixels; it grows for coarser features, which are located less exactly.
        max_distance: Maximum Hamming distance of a match, in bits.
        ratio: The distance of the best feature must be below this share of the second best of its octave.
        plan: Settings of feature extraction.
        images: Number of the image that each point is predicted in, and of the image of each feature; all are of one
            image if not given. Six images in one call take three quarters of the time of six calls.

    Returns:
        `(2, k)` index of the point and of the feature of every match, points ascending. A feature that is the best
        match of several points goes to the most similar one.
    """
    point, feature = _near(predicted_uv, octave, features, radius_px, plan, images)
    distance = hamming_pairs(descriptor[point], features.descriptor[feature])
    point, distance, feature = sorted_together(point, distance, feature)
    good = _first(point) & (distance <= max_distance)
    # The second best may be the same corner at another octave, so only its own octave counts, as in ORB-SLAM.
    same = np.append((point[1:] == point[:-1]) & (np.diff(features.octave[feature].astype(np.int64)) == 0), False)
    good &= ~(same & (distance >= ratio * np.append(distance[1:], _BITS)))
    point, feature, distance = point[good], feature[good], distance[good]
    feature, _, point = sorted_together(feature, distance, point)
    first = _first(feature)
    return np.stack(sorted_together(point[first], feature[first]))


def _near(
    predicted_uv: Float[np.ndarray, "2 p"],
    octave: Integer[np.ndarray, " p"],
    features: Features,
    radius_px: float,
    plan: FeaturePlan,
    images: tuple[Int[np.ndarray, " p"], Int[np.ndarray, " n"]] | None,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Find the pairs of points and features of one image and similar octave within the search radius of the octave.

    Features are sorted by image, by the level of the points that look for them, by bands of rows as high as a search is
    wide, and by column: a point looks at a piece of two bands. That takes a third of the time of k-d trees of each
    level.
    """
    radius = radius_px * plan.scale_factor ** np.arange(plan.num_levels)
    wanted_by = features.octave.astype(np.int64) + np.arange(-_OCTAVES_APART, _OCTAVES_APART + 1)[:, None]
    apart, feature = np.nonzero((wanted_by >= 0) & (wanted_by < plan.num_levels))
    wanted_by = wanted_by[apart, feature]
    sought = np.flatnonzero(np.isfinite(predicted_uv).all(axis=0))
    uv, level = predicted_uv[:, sought].astype(np.float64), octave[sought].astype(np.int64)
    reach, height = radius[level], 2 * radius[wanted_by]
    if images is not None:
        level = level + plan.num_levels * images[0][sought]
        wanted_by = wanted_by + plan.num_levels * images[1][feature]

    uv_there = features.uv[:, feature].astype(np.float64)
    places = _places(wanted_by, uv_there[1] / height, uv_there[0])
    order = np.argsort(places)
    places, feature, uv_there = places[order], feature[order], uv_there[:, order]
    point = np.tile(np.arange(len(sought)), 2)
    band = np.concatenate([(uv[1] - reach) / (2 * reach), (uv[1] + reach) / (2 * reach)])
    begin = np.searchsorted(places, _places(level[point], band, uv[0, point] - reach[point]) - _SLACK_PX)
    end = np.searchsorted(places, _places(level[point], band, uv[0, point] + reach[point]) + _SLACK_PX)
    count = end - begin
    at = np.arange(count.sum()) + np.repeat(begin - (np.cumsum(count) - count), count)
    u, v, limit = (np.repeat(each[point], count) for each in (*uv, np.square(reach)))
    near = np.square(uv_there[0, at] - u) + np.square(uv_there[1, at] - v) <= limit
    return sought[np.repeat(point, count)[near]], feature[at[near]]


def _places(
    level: Int[np.ndarray, " n"], band: Float[np.ndarray, " n"], column: Float[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Return numbers that sort by level, then by the whole part of the band, then by column."""
    band = np.clip(np.floor(band), -_FARTHEST, _FARTHEST)
    return (level * (4 * _FARTHEST) + band) * (4 * _FARTHEST) + np.clip(column, -_FARTHEST, _FARTHEST)


def _first(groups: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return which entries are the first of their group; groups must be contiguous."""
    return np.append(True, groups[1:] != groups[:-1])[: len(groups)]


def _words(descriptor: UInt8[np.ndarray, "n 32"]) -> UInt64[np.ndarray, "4 n"]:
    """View the descriptors as `(4, n)` uint64."""
    return np.ascontiguousarray(np.ascontiguousarray(descriptor).view(np.uint64).T)
