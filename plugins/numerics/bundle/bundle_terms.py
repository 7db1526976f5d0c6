"""Residuals of lines and planes in bundle adjustment with their derivatives by the landmark; those by the pose are `pose_terms`'. For numba loops.

A line moves across itself only, by two tangent coordinates at each of its two points (four unknowns, as a line has); a plane moves by the tangent
coordinates of its normal and d.
"""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F64
from trihedron.plugins.numerics.maps.map_terms import EXTEND
from trihedron.plugins.numerics.motion.pose_terms import PARALLEL, basis, chain_point, line_depth_row, line_row, to_camera


@numba.njit(cache=True, nogil=True, error_model="numpy")
def share_opposite(R: F64, t: F64, line: F64, pixel: F64, camera: F64) -> float:
    """Where along a world line (2, 3; 0 = start, 1 = end) lies the point nearest to the ray through a pixel; at most EXTEND beyond its ends."""
    ray, along, to_start = np.empty(3), np.empty(3), np.empty(3)
    x, y = (pixel[0] - camera[2]) / camera[0], (pixel[1] - camera[3]) / camera[1]
    rr, ra, rs = 0.0, 0.0, 0.0
    for j in range(3):
        ray[j] = R[j, 0] * x + R[j, 1] * y + R[j, 2]
        along[j] = line[1, j] - line[0, j]
        to_start[j] = line[0, j] - t[j]
        rr += ray[j] * ray[j]
        ra += ray[j] * along[j]
        rs += ray[j] * to_start[j]
    top, bottom = 0.0, 0.0
    for j in range(3):
        normal = along[j] * rr - ray[j] * ra  # across the ray, in the plane it spans with the line
        top -= to_start[j] * normal
        bottom += along[j] * normal
    share = top / bottom if bottom > 1e-12 else 0.0
    return min(max(share, -EXTEND), 1.0 + EXTEND)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_term(
    R: F64, t: F64, line: F64, N: F64, share: float, segment_px: F64, camera: F64, J_pose: F64, J_line: F64, D: F64, p: F64
) -> tuple[float, float]:
    """Distance (px) of the line's point at `share` from the observed segment (2, 2), and where along that it falls; NaN behind the camera. J_pose
    (6,), J_line (4,) by the coordinates in N (3, 2) of the first and of the second point. D (1, 3), p (3,): p is left as the camera-frame point."""
    x = np.empty(3)
    for j in range(3):
        x[j] = (1.0 - share) * line[0, j] + share * line[1, j]
    to_camera(R, t, x, p)
    r, along = line_row(p, segment_px, camera, D[0])
    _line_chain(R, N, share, J_pose, J_line, D, p)
    return r, along


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_depth_term(R: F64, N: F64, share: float, observed_m: F64, m: F64, J_pose: F64, J_line: F64, D: F64, p: F64) -> tuple[float, float]:
    """As `line_term` for the distance (m) of the camera-frame point p from the observed 3D segment (2, 3) along m (3,)."""
    r, along = line_depth_row(p, observed_m, m)
    for j in range(3):
        D[0, j] = m[j]
    _line_chain(R, N, share, J_pose, J_line, D, p)
    return r, along


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _line_chain(R: F64, N: F64, share: float, J_pose: F64, J_line: F64, D: F64, p: F64) -> None:
    J = np.empty((1, 6))
    chain_point(D, len(J), p, J)
    J_pose[:] = J[0]
    J_line[:] = 0.0
    for j in range(3):
        d = D[0, 0] * R[j, 0] + D[0, 1] * R[j, 1] + D[0, 2] * R[j, 2]
        for a in range(2):
            J_line[a] += (1.0 - share) * d * N[j, a]
            J_line[2 + a] += share * d * N[j, a]


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
