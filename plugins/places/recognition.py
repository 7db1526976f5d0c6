"""Place recognition: candidate keyframes by descriptor votes, and hypotheses of the camera pose from points of similar appearance."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Keypoints, Map, Segments
from trihedron.plugins.mapping.covisibility_graph import WEIGHTS, are_distinct, observed_by
from trihedron.plugins.mapping.landmark_kinds import LINE, POINT, landmarks_of
from trihedron.plugins.shared.feature_matching import nearest_matches
from trihedron.plugins.shared.rigid_alignment_kernels import rigid_hypotheses_kernel


def candidate_keyframes(map: Map, keypoints: Keypoints, segments: Segments, keyframes: I32, count: int, max_bits: int) -> I32:
    """Return the `count` of the keyframes, sorted, that observed most landmarks similar to this frame's points and lines; all when they are no
    more."""
    if len(keyframes) <= count:
        return keyframes
    votes = np.zeros(len(map.keyframes), np.int64)
    for kind, features, weight in ((POINT, keypoints, 1), (LINE, segments, WEIGHTS[LINE])):
        ids = observed_by(map, keyframes, kind)
        table = landmarks_of(map)[kind]
        rows = nearest_matches(features.descriptors, table.rows("descriptor", ids), max_bits, 1.0)
        observers = table.rows("observers", ids[np.unique(rows[rows >= 0])])
        votes += weight * np.bincount(observers[observers >= 0], minlength=len(votes))
    order = keyframes[np.argsort(-votes[keyframes], kind="stable")]
    return np.sort(order[:count]).astype(np.int32)


def block_of(keyframes: I32, size: int, number: int) -> I32:
    """Return the `number`-th block of `size` keyframes, modulo their count; blocks overlap by half. A large map is searched block by block, which
    bounds the time of a frame."""
    if len(keyframes) <= size:
        return keyframes
    starts = np.arange(0, len(keyframes) - size // 2, size // 2)
    start = min(int(starts[number % len(starts)]), len(keyframes) - size)
    return keyframes[start : start + size]


def rigid_hypotheses(camera_m: F64, world_m: F64, sigma_m: F64, samples: I32, count: int) -> F64:
    """Return up to `count` distinct poses `T_world_camera` (k, 4, 4), each by three pairs of points (Procrustes), those with most inliers first.

    The n pairs of points (n, 3) have errors `sigma_m` (n,); `samples` (m, 3) are the triples to try."""
    poses, inliers = rigid_hypotheses_kernel(camera_m, world_m, 3.0 * sigma_m, samples)
    order = np.argsort(-inliers, kind="stable")
    return distinct_poses(poses[order[inliers[order] >= 6]], count)


def distinct_poses(poses: F64, count: int) -> F64:
    """Return the first `count` of the poses (n, 4, 4) that differ from each before."""
    chosen: list[F64] = []
    for T in poses:
        if len(chosen) == count:
            break
        if all(are_distinct(T, other) for other in chosen):
            chosen.append(T)
    return np.array(chosen).reshape(-1, 4, 4)
