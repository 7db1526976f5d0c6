"""By how much a camera that came back has drifted: a displacement on which points that look alike, or the layout of planes, agree.

The rotation does not drift, so what was seen again is shifted, and turned by so little that the refinement that follows finds it."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform, umeyama
from trihedron.pipeline.core.types import F64, I32, Bool, Camera, Keypoints, Map
from trihedron.plugins.numerics.images.descriptors import match_near
from trihedron.plugins.numerics.planes.plane_association import associate_planes, overlap

ALIKE_BITS, ALIKE_L2, RATIO = 60, 200, 0.85  # between descriptors of two views, and best to second best (ORB-SLAM2: 50 to 100 bits)
LAYOUT_DEG, LAYOUT_M = 10.0, 0.05  # between the directions of planes that may be one; between their offsets, displaced
SCALES_M = (0.1, 0.3, 0.9, 3.0)  # between their offsets before
EXTENT_M = 0.5  # within which a sample of one plane has one of the other where both extend
ROUNDS, FEWEST = 3, 6  # of a refinement; points


def alike(map: Map, camera: Camera, T_world_camera: F64, keypoints: Keypoints, ids: I32, sigma_m: float, sigma_rad: float) -> I32:
    """(n, 2) pairs (row of the keyframe's points, id among `ids`) that look alike within three standard deviations of where they are expected."""
    local = transform(invert(T_world_camera), map.points.rows("position_m", ids))
    ids, local = ids[local[:, 2] > 0.1], local[local[:, 2] > 0.1]
    depth = np.maximum(keypoints.points_m[:, 2].astype(np.float64), 0.5)
    radius = 3.0 * camera.fx * (sigma_m / depth + sigma_rad)
    limit = ALIKE_L2 if keypoints.metric == "l2" else ALIKE_BITS
    found = match_near(
        keypoints.pixels, keypoints.descriptors, keypoints.octaves,
        camera.project(local).astype(np.float32), map.points.rows("descriptor", ids), map.points.rows("octave", ids),
        radius.astype(np.float32), 3, limit, RATIO, keypoints.metric,
    )  # fmt: skip
    rows = np.flatnonzero(found >= 0)
    return np.stack([rows, ids[found[rows]]], axis=1).astype(np.int32)


def shift_of_points(here: F64, there: F64, sigma_m: F64) -> F64:
    """Motion T (4, 4) with `there ≈ T here` for most of the pairs of points (n, 3), each good to `sigma_m` (n,): each pair says a displacement, and
    the one most others share is refined to a motion. The identity where fewer than FEWEST agree."""
    T = np.eye(4)
    if len(here) < FEWEST:
        return T
    shift = there - here
    near = np.linalg.norm(shift[:, None] - shift[None], axis=2) < 3.0 * np.hypot(sigma_m[:, None], sigma_m[None])
    chosen = near[np.argmax(near.sum(axis=1))]
    for _ in range(ROUNDS):
        if np.count_nonzero(chosen) < FEWEST:
            return np.eye(4)
        T = umeyama(here[chosen], there[chosen])
        chosen = np.linalg.norm(there - transform(T, here), axis=1) < 3.0 * sigma_m
    return T


def shift_of_planes(map: Map, here: I32, there: I32, sigma_m: float) -> tuple[F64, float]:
    """Displacement (3,) that brings the planes `here` onto those `there`, as far as they say, and how much of their extent agrees (in planes).

    Planes of one direction are paired when their offsets differ by little, then by more, up to three standard deviations; the displacement
    under which most agrees is taken, the smaller one when two are alike."""
    planes = [map.planes.rows("coefficients", ids) for ids in (here, there)]
    samples = [map.planes.rows("samples_m", ids) for ids in (here, there)]
    best, agreed = np.zeros(3), 0.0
    for reach_m in sorted({min(reach, 3.0 * sigma_m) for reach in SCALES_M}):
        pairs = associate_planes(planes[0], samples[0], planes[1], samples[1], LAYOUT_DEG, reach_m, True)
        n, offset = planes[0][pairs[:, 0], :3], planes[0][pairs[:, 0], 3] - planes[1][pairs[:, 1], 3]
        shift, kept = _shift(n, offset, sigma_m)
        score = float(sum(overlap(samples[0][a] + shift.astype(np.float32), samples[1][b], EXTENT_M) for a, b in pairs[kept]))
        if score > 1.1 * agreed:
            best, agreed = shift, score
    return best, agreed


def _shift(n: F64, offset: F64, sigma_m: float) -> tuple[F64, Bool]:
    """Least squares of `n · shift = offset` (k, 3), (k,) with a prior, without those that contradict the rest; the shift and which were kept."""
    shift, kept = np.zeros(3), np.ones(len(n), np.bool_)
    for _ in range(len(n)):
        A = n[kept].T @ n[kept] / LAYOUT_M**2 + np.eye(3) / max(sigma_m, 1e-3) ** 2
        shift = np.linalg.solve(A, n[kept].T @ offset[kept] / LAYOUT_M**2)
        error = np.where(kept, np.abs(n @ shift - offset), 0.0)
        if error.max() < LAYOUT_M:
            break
        kept[np.argmax(error)] = False
    return shift, kept
