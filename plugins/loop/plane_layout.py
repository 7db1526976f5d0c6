"""The displacement on which the layouts of two sets of planes agree."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.linalg import matmul, solve
from trihedron.pipeline.core.types import F64, I32, Bool, Map
from trihedron.plugins.shared.feature_matching import associate_planes
from trihedron.plugins.shared.feature_matching_kernels import overlap

LAYOUT_DEG, LAYOUT_M = 10.0, 0.05  # between the normals of planes that may be one; between their offsets, displaced
SCALES_M = (0.1, 0.3, 0.9, 3.0)  # between their offsets before
EXTENT_M = 0.5  # within which a sample of one plane has one of the other where both extend


def displacement_of_planes(map: Map, here: I32, there: I32, sigma_m: float) -> tuple[F64, float]:
    """Return the displacement (3,) of the planes `here` onto those `there`, as far as they observe it, and the agreeing extent (in planes).

    Planes with the same normal are paired when their offsets differ by little, then by more, up to three standard deviations; the displacement with
    the largest agreeing extent is taken, the smaller one of two that are similar."""
    planes = [map.planes.rows("coefficients", ids) for ids in (here, there)]
    samples = [map.planes.rows("samples_m", ids) for ids in (here, there)]
    best, agreed = np.zeros(3), 0.0
    for reach_m in sorted({min(reach, 3.0 * sigma_m) for reach in SCALES_M}):
        pairs = associate_planes(planes[0], samples[0], planes[1], samples[1], LAYOUT_DEG, reach_m, True)
        n, offset = planes[0][pairs[:, 0], :3], planes[0][pairs[:, 0], 3] - planes[1][pairs[:, 1], 3]
        shift, inliers = _solve_displacement(n, offset, sigma_m)
        score = float(sum(overlap(samples[0][a] + shift.astype(np.float32), samples[1][b], EXTENT_M) for a, b in pairs[inliers]))
        if score > 1.1 * agreed:
            best, agreed = shift, score
    return best, agreed


def _solve_displacement(n: F64, offset: F64, sigma_m: float) -> tuple[F64, Bool]:
    """Least squares of `n · shift = offset` (k, 3), (k,) with a prior, without outliers; the shift and the inliers."""
    shift, inliers = np.zeros(3), np.ones(len(n), np.bool_)
    for _ in range(len(n)):
        A = matmul(n[inliers].T, n[inliers]) / LAYOUT_M**2 + np.eye(3) / max(sigma_m, 1e-3) ** 2
        shift = np.asarray(solve(A, matmul(n[inliers].T, offset[inliers]) / LAYOUT_M**2), np.float64)
        error = np.where(inliers, np.abs(matmul(n, shift) - offset), 0.0)
        if error.max() < LAYOUT_M:
            break
        inliers[np.argmax(error)] = False
    return shift, inliers
