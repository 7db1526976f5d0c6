"""Numba kernel of `linear_translation.py`: iteratively reweighted least squares of the de-rotated reprojection error."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import F64

ITERATIONS = 15
CAUCHY = 2.385  # 95 % efficiency where the noise is Gaussian
GATE = 3.0  # standard deviations, beyond which a point is an outlier
FLOOR_M = 0.01  # least |s| in the noise of points without depth, which is proportional to it
NEAR_M = 0.1  # least depth in the noise of points with depth
SIGMAS = 0.849  # standard deviation in each of two directions, where the median length is 1
LEAST_SCALE = 0.3  # of the residuals' standard deviation to that of their noise
ALONE = 4  # first iterations, by points with depth alone: at s = 0 the others agree with everything
STEP2 = 1e-14  # m², of the last step


@kernel
def iterate_translation(A: F64, b: F64, z: F64, sigma: F64, start: F64, prior_m: float) -> tuple[F64, F64, int]:
    """Solve the equations (`PointEquations`: (n, 2, 3), (n, 2), (n,), (n,)) for the translation `s` (3,), from `start`, about which its standard
    deviation is `prior_m`. Returns it, the information (3, 3) of the points alone, and the number of inliers.

    The equation of a point without depth is `(b × b')·s = 0`; its residual is divided by |s|, linearised, and multiplied by it again."""
    n, with_depth = len(z), np.isfinite(z)
    any_depth = np.any(with_depth)
    s, along, a = start.copy(), np.zeros(3), np.zeros(3)
    noise, size = np.empty(n), np.empty(n)
    H, damped, g, solution, scale = np.zeros((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), 1.0
    for iteration in range(ITERATIONS if n else 0):
        length = np.sqrt(s[0] ** 2 + s[1] ** 2 + s[2] ** 2)
        along[:] = s / max(length, 1e-9)
        for i in range(n):
            noise[i] = sigma[i] * (max(z[i] + s[2], NEAR_M) if with_depth[i] else length + FLOOR_M)
            size[i] = 0.0
            for j in range(2):
                size[i] += (A[i, j, 0] * s[0] + A[i, j, 1] * s[1] + A[i, j, 2] * s[2] - b[i, j]) ** 2
            size[i] = np.sqrt(size[i]) / noise[i]
        scale = max(SIGMAS * np.median(size[with_depth]) if any_depth else 1.0, LEAST_SCALE)
        H[:], g[:] = 0.0, start / prior_m**2
        for i in range(n):
            if any_depth and iteration < ALONE and not with_depth[i]:
                continue
            weight = 1.0 / (1.0 + (size[i] / (CAUCHY * scale)) ** 2) / (noise[i] * scale) ** 2
            for j in range(2):
                a[:], right = A[i, j], b[i, j]
                if not with_depth[i]:
                    off = a[0] * along[0] + a[1] * along[1] + a[2] * along[2]
                    right = -max(length, 1e-9) * off
                    a -= off * along
                for r in range(3):
                    g[r] += weight * a[r] * right
                    for c in range(3):
                        H[r, c] += weight * a[r] * a[c]
        damped[:] = H
        for r in range(3):
            damped[r, r] += 1.0 / prior_m**2
        solve_positive(damped, g, solution)
        step2 = np.sum((solution - s) ** 2)
        s[:] = solution
        if step2 < STEP2 and iteration >= ALONE:
            break
    return s, H, int(np.count_nonzero(size < GATE * scale))
