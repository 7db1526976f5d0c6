"""The initial pose of a keyframe at a place, before the geometric verification refines it.

The drift is mostly a displacement, on which similar points, or the layout of planes, agree. The rotation hardly drifts, so the refinement that
follows finds it.
"""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix, transform, umeyama
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Camera, Keypoints, Map
from trihedron.plugins.loop.plane_layout import displacement_of_planes
from trihedron.plugins.mapping.covisibility_graph import LocalWindow
from trihedron.plugins.shared.feature_matching import match_near

MAX_BITS, MAX_L2, RATIO = 60, 200, 0.85  # between descriptors of two views, and best to second best (ORB-SLAM2: 50 to 100 bits)
ROUNDS, MIN_POINTS = 3, 6  # of a refinement; points


def initial_pose(map: Map, camera: Camera, place: LocalWindow, window: LocalWindow, keypoints: Keypoints, T: F64, expected: F64) -> F64:
    """Select, from the pose without drift, the one where the planes lie on those of the place, and the one where similar points agree, that with most
    agreeing points."""
    sigma_m, sigma_rad = np.sqrt(expected[0, 0]), np.sqrt(expected[3, 3])
    pairs = _match_points(map, camera, T, keypoints, place.points, sigma_m, sigma_rad)
    points, there = keypoints.points_m[pairs[:, 0]].astype(np.float64), map.points.rows("position_m", pairs[:, 1])
    sigma = 0.01 + keypoints.sigma_m[pairs[:, 0]].astype(np.float64) + sigma_rad * points[:, 2]
    by_planes = displacement_of_planes(map, window.planes, place.planes, sigma_m)[0]
    starts = [T, pose_matrix(T[:3, :3], T[:3, 3] + by_planes), matmul(_motion_of_points(transform(T, points), there, sigma), T)]
    agreeing = [np.count_nonzero(np.linalg.norm(transform(start, points) - there, axis=1) < 3.0 * sigma) for start in starts]
    return starts[int(np.argmax(agreeing))]


def _match_points(map: Map, camera: Camera, T_world_camera: F64, keypoints: Keypoints, ids: I32, sigma_m: float, sigma_rad: float) -> I32:
    """Pairs (row of the keyframe's points, id among `ids`), (n, 2), with similar descriptors within three standard deviations of the projection."""
    local = transform(invert(T_world_camera), map.points.rows("position_m", ids))
    ids, local = ids[local[:, 2] > 0.1], local[local[:, 2] > 0.1]
    depth = np.maximum(keypoints.points_m[:, 2].astype(np.float64), 0.5)
    radius = 3.0 * camera.fx * (sigma_m / depth + sigma_rad)
    found = match_near(
        keypoints.pixels, keypoints.descriptors, keypoints.octaves,
        camera.project(local).astype(np.float32), map.points.rows("descriptor", ids), map.points.rows("octave", ids),
        radius.astype(np.float32), 3, MAX_L2 if keypoints.metric == "l2" else MAX_BITS, RATIO, keypoints.metric,
    )  # fmt: skip
    rows = np.flatnonzero(found >= 0)
    return np.stack([rows, ids[found[rows]]], axis=1).astype(np.int32)


def _motion_of_points(here: F64, there: F64, sigma_m: F64) -> F64:
    """Motion T (4, 4) with `there ≈ T here` for most of the pairs of points (n, 3) with errors `sigma_m` (n,): the displacement that most pairs
    share, refined to a motion. The identity where fewer than MIN_POINTS agree."""
    T = np.eye(4)
    if len(here) < MIN_POINTS:
        return T
    shift = there - here
    near = np.linalg.norm(shift[:, None] - shift[None], axis=2) < 3.0 * np.hypot(sigma_m[:, None], sigma_m[None])
    chosen = near[np.argmax(near.sum(axis=1))]
    for _ in range(ROUNDS):
        if np.count_nonzero(chosen) < MIN_POINTS:
            return np.eye(4)
        T = umeyama(here[chosen], there[chosen])
        chosen = np.linalg.norm(there - transform(T, here), axis=1) < 3.0 * sigma_m
    return T
