"""Matching ORB features: with those of another image, and with map points where a pose puts them."""

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8, UInt16

from jaxslam.features.orb import DEFAULT_PLAN, FeaturePlan, Features

FAR = 100
"""Bits that may differ where something else speaks for a match: `TH_HIGH` of ORB-SLAM (Mur-Artal et al. 2015)."""
NEAR = 50
"""Bits that may differ where only descriptors speak for it: `TH_LOW` there."""
_BITS = 256
_TURN_BINS = 30
_TURN_PEAKS = 3
_MIN_PEAK = 0.1
"""Bins of the turn between two images, how many of the fullest are kept, and their least size relative to the
fullest: `HISTO_LENGTH` and `ComputeThreeMaxima` of ORB-SLAM."""
_OCTAVES_APART = 1
_ROWS = 32
"""Rows of a table of distances done at a time, so that they stay in the cache."""


def hamming(a: UInt8[np.ndarray, "n 32"], b: UInt8[np.ndarray, "m 32"]) -> UInt16[np.ndarray, "n m"]:
    """In how many bits every descriptor of `a` differs from every one of `b`.

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
    """In how many bits every descriptor of `a` differs from the same one of `b`."""
    return np.bitwise_count(_words(a) ^ _words(b)).sum(axis=0, dtype=np.uint16)


def match_descriptors(
    a: Features, b: Features, *, max_distance: int = NEAR, ratio: float = 0.75, check_turn: bool = True
) -> Int64[np.ndarray, "2 k"]:
    """Features of two images that look alike, wherever they are.

    Args:
        a: Features of the first image.
        b: Features of the second one.
        max_distance: Most bits that differ.
        ratio: The best match of a feature of `a` must differ in less than this share of the bits of the second best.
        check_turn: Drop matches whose patches turned otherwise than most did.

    Returns:
        Index in `a` and in `b` of every match, the two being each other's best; ascending in `a`.
    """
    if not len(a.descriptor) or not len(b.descriptor):
        return np.zeros((2, 0), np.int64)
    distance = hamming(a.descriptor, b.descriptor)
    best = distance.argmin(axis=1)
    least = np.partition(distance, min(1, len(b.descriptor) - 1), axis=1)[:, :2]
    index = np.arange(len(best))
    good = (distance.argmin(axis=0)[best] == index) & (least[:, 0] <= max_distance)
    if len(b.descriptor) > 1:
        good &= least[:, 0] < ratio * least[:, 1]
    pairs = np.stack([index[good], best[good]])
    return pairs[:, same_turn(b.angle[pairs[1]] - a.angle[pairs[0]])] if check_turn else pairs


def same_turn(turn: Float32[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which of the angles, radians, are among the few that many share."""
    bins = np.round(turn * (_TURN_BINS / (2 * np.pi))).astype(np.int64) % _TURN_BINS
    counts = np.bincount(bins, minlength=_TURN_BINS)
    fullest = np.argsort(-counts, kind="stable")[:_TURN_PEAKS]
    return np.isin(bins, fullest[counts[fullest] >= _MIN_PEAK * counts[fullest[0]]])


def predicted_octave(
    octave: np.ndarray, depth_then: np.ndarray, depth_now: np.ndarray, plan: FeaturePlan = DEFAULT_PLAN
) -> Int64[np.ndarray, " n"]:
    """The octave of features seen from another distance: size in the image goes with the inverse of depth.

    Args:
        octave: `(n,)` where they were found.
        depth_then: `(n,)` their depth there, meters, positive.
        depth_now: `(n,)` their depth where they are to be found, meters, positive.
        plan: How features are found.
    """
    change = np.log(depth_then / depth_now) / np.log(plan.scale_factor)
    return np.clip(np.round(octave + change), 0, plan.num_levels - 1).astype(np.int64)


def match_by_projection(
    predicted_uv: np.ndarray,
    octave: np.ndarray,
    descriptor: UInt8[np.ndarray, "p 32"],
    features: Features,
    *,
    radius_px: float,
    max_distance: int = FAR,
    ratio: float = 0.9,
    plan: FeaturePlan = DEFAULT_PLAN,
) -> Int64[np.ndarray, "2 k"]:
    """Map points found among features near where a pose puts them.

    Args:
        predicted_uv: `(2, p)` pixels of the ideal camera, as `features.uv`. A point that is not finite is not sought.
        octave: `(p,)` of `predicted_octave`; features of neighboring octaves are looked at too.
        descriptor: Of the points.
        features: Of the image.
        radius_px: How far to look at octave 0; further for coarser features, which are located less exactly.
        max_distance: Most bits that differ.
        ratio: The best feature must differ in less than this share of the bits of the second best of its octave.
        plan: How features are found.

    Returns:
        Index of the point and of the feature of every match; ascending points. A feature that is the best of several
        points goes to the one it is most like.
    """
    point, feature = _near(predicted_uv, octave, features, radius_px, plan)
    distance = hamming_pairs(descriptor[point], features.descriptor[feature])
    order = np.lexsort((feature, distance, point))
    point, feature, distance = point[order], feature[order], distance[order]
    good = _first(point) & (distance <= max_distance)
    # The second best may be the same corner at another octave, so only its own octave counts, as in ORB-SLAM.
    same = np.append((point[1:] == point[:-1]) & (np.diff(features.octave[feature].astype(np.int64)) == 0), False)
    good &= ~(same & (distance >= ratio * np.append(distance[1:], _BITS)))
    point, feature, distance = point[good], feature[good], distance[good]
    order = np.lexsort((point, distance, feature))
    order = order[_first(feature[order])]
    return np.stack([point[order], feature[order]])[:, np.argsort(point[order], kind="stable")]


def _near(
    predicted_uv: np.ndarray, octave: np.ndarray, features: Features, radius_px: float, plan: FeaturePlan
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of points and features of like octave within the radius of it."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - see `late_imports`

    finite = np.isfinite(predicted_uv).all(axis=0)
    pairs = [np.zeros((2, 0), np.int64)]
    for level in range(plan.num_levels):
        sought = np.flatnonzero((octave == level) & finite)
        apart = np.abs(features.octave.astype(np.int64) - level)
        there = np.flatnonzero(apart <= _OCTAVES_APART)
        if not len(sought) or not len(there):
            continue
        of_points, of_features = (KDTree(uv.T) for uv in (predicted_uv[:, sought], features.uv[:, there]))
        radius = radius_px * plan.scale_factor**level
        near = of_points.sparse_distance_matrix(of_features, radius, output_type="ndarray")
        pairs.append(np.stack([sought[near["i"]], there[near["j"]]]))
    point, feature = np.concatenate(pairs, axis=1)
    return point, feature


def _first(groups: np.ndarray) -> np.ndarray:
    """Which entries are the first of their group, groups being contiguous."""
    return np.append(True, groups[1:] != groups[:-1])[: len(groups)]


def _words(descriptor: UInt8[np.ndarray, "n 32"]) -> np.ndarray:
    """`(4, n)` uint64."""
    return np.ascontiguousarray(np.ascontiguousarray(descriptor).view(np.uint64).T)
