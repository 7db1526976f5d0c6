"""Residuals of lines and planes in bundle adjustment with their derivatives by the landmark; those by the pose are `pose_terms`'. For numba loops.

A line moves across itself only, by two tangent coordinates at each of its two points (four unknowns, as a line has); a plane moves by the tangent
coordinates of its normal and d.
"""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64
from trihedron.plugins.numerics.maps.map_terms import EXTEND
from trihedron.plugins.numerics.motion.pose_terms import PARALLEL, basis, line_depth_row, line_row


@numba.njit(cache=True, nogil=True, error_model="numpy")
def share_opposite(R: F64, t: F64, line: F64, pixel: F64, camera: F64) -> float:
    """Where along a world line (2, 3; 0 = start, 1 = end) lies the point nearest to the ray through a pixel; at most EXTEND beyond its ends."""
    x, y = (pixel[0] - camera[2]) / camera[0], (pixel[1] - camera[3]) / camera[1]
    r0, r1, r2 = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2], R[2, 0] * x + R[2, 1] * y + R[2, 2]
    a0, a1, a2 = line[1, 0] - line[0, 0], line[1, 1] - line[0, 1], line[1, 2] - line[0, 2]
    rr, ra = r0 * r0 + r1 * r1 + r2 * r2, r0 * a0 + r1 * a1 + r2 * a2
    n0, n1, n2 = a0 * rr - r0 * ra, a1 * rr - r1 * ra, a2 * rr - r2 * ra  # across the ray, in the plane it spans with the line
    top = -(line[0, 0] - t[0]) * n0 - (line[0, 1] - t[1]) * n1 - (line[0, 2] - t[2]) * n2
    bottom = a0 * n0 + a1 * n1 + a2 * n2
    share = top / bottom if bottom > 1e-12 else 0.0
    return min(max(share, -EXTEND), 1.0 + EXTEND)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_term(R: F64, t: F64, line: F64, N: F64, share: float, segment_px: F64, camera: F64, J: F64, p: F64) -> tuple[float, float]:
    """Distance (px) of the line's point at `share` from the observed segment (2, 2), and where along that it falls; NaN behind the camera. J (10,):
    by the pose, and by the coordinates in N (3, 2) of the line's first and of its second point. p (3,) is left as the camera-frame point."""
    x = (1.0 - share) * line[0, 0] + share * line[1, 0] - t[0]
    y = (1.0 - share) * line[0, 1] + share * line[1, 1] - t[1]
    z = (1.0 - share) * line[0, 2] + share * line[1, 2] - t[2]
    for k in range(3):
        p[k] = R[0, k] * x + R[1, k] * y + R[2, k] * z
    r, along = line_row(p, segment_px, camera, J)
    _line_chain(R, N, share, J[0], J[1], J[2], p, J)
    return r, along


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_depth_term(R: F64, N: F64, share: float, observed_m: F64, m: F64, J: F64, p: F64) -> tuple[float, float]:
    """As `line_term` for the distance (m) of the camera-frame point p from the observed 3D segment (2, 3) along m (3,)."""
    _line_chain(R, N, share, m[0], m[1], m[2], p, J)
    return line_depth_row(p, observed_m, m)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _line_chain(R: F64, N: F64, share: float, a: float, b: float, c: float, p: F64, J: F64) -> None:
    """J (10,) of `line_term` from the derivatives by the camera-frame point p."""
    J[0], J[1], J[2] = -a, -b, -c
    J[3], J[4], J[5] = b * p[2] - c * p[1], c * p[0] - a * p[2], a * p[1] - b * p[0]
    d0, d1, d2 = a * R[0, 0] + b * R[0, 1] + c * R[0, 2], a * R[1, 0] + b * R[1, 1] + c * R[1, 2], a * R[2, 0] + b * R[2, 1] + c * R[2, 2]
    for k in range(2):
        J[6 + k] = (1.0 - share) * d0 * N[0, k] + (1.0 - share) * d1 * N[1, k] + (1.0 - share) * d2 * N[2, k]
        J[8 + k] = share * d0 * N[0, k] + share * d1 * N[1, k] + share * d2 * N[2, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def by_plane(R: F64, t: F64, world: F64, B: F64, J: F64) -> None:
    """J (3, 3): derivative of `plane_rows` of kind SAME by the (a, b, d) of the world plane; B is `basis` of the observed normal."""
    Bw = np.empty((3, 2))
    basis(world, Bw)
    J[:] = 0.0
    for j in range(2):
        for k in range(2):
            for i in range(3):
                J[k, j] += B[i, k] * (R[0, i] * Bw[0, j] + R[1, i] * Bw[1, j] + R[2, i] * Bw[2, j])
        J[2, j] = t[0] * Bw[0, j] + t[1] * Bw[1, j] + t[2] * Bw[2, j]
    J[2, 2] = 1.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def relation_rows(kind: int, first: F64, second: F64, B: F64, r: F64, J_first: F64, J_second: F64) -> int:
    """Parallel or perpendicular world planes: r (2,), J_first and J_second (2, 3) by their (a, b, d); returns the number of rows.

    PARALLEL: the difference of the normals, for either orientation, in B (3, 2), the basis of the second. PERPENDICULAR: their product."""
    A, S = np.empty((3, 2)), np.empty((3, 2))
    basis(first, A)
    basis(second, S)
    J_first[:], J_second[:] = 0.0, 0.0
    dot = first[0] * second[0] + first[1] * second[1] + first[2] * second[2]
    if kind != PARALLEL:
        r[0] = dot
        for j in range(2):
            for i in range(3):
                J_first[0, j] += second[i] * A[i, j]
                J_second[0, j] += first[i] * S[i, j]
        return 1
    sign = -1.0 if dot < 0.0 else 1.0
    for k in range(2):
        r[k] = 0.0
        for i in range(3):
            r[k] += B[i, k] * (sign * first[i] - second[i])
            for j in range(2):
                J_first[k, j] += sign * B[i, k] * A[i, j]
                J_second[k, j] -= B[i, k] * S[i, j]
    return 2
