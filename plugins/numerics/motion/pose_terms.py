"""Residuals and analytic Jacobians of one camera pose against known points, lines and planes (eqs. 2–8), for numba loops.

The pose is `R, t` of `T_world_camera`; derivatives are with respect to `xi = (rho, phi)` in `T_world_camera · Exp(xi)`, so that a camera-frame
point p moves with `dp/drho = -I`, `dp/dphi = [p]×`. `camera` is (fx, fy, cx, cy).

What is called for each term is made part of its caller (`forceinline`): to hand over an array takes numba seven numbers and a count of references,
as long as what is done with it here.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32

SAME, PARALLEL, PERPENDICULAR = 0, 1, 2  # kinds of plane terms
NEAR_M = 0.05  # a point nearer than this to the image plane is not projected


class PointTerms(NamedTuple):
    """n world points and what was measured of them; `depth_m` NaN = pixel only."""

    positions_m: F64  # (n, 3) world
    covariance_m2: F64  # (n, 3, 3) world, of the positions
    pixels: F64  # (n, 2)
    depth_m: F64  # (n,)
    sigma_px: F64  # (n,)
    sigma_m: F64  # (n,) of the depth


class LineTerms(NamedTuple):
    """m world lines by two points each, and the segments seen; `observed_m` NaN = image only."""

    endpoints_m: F64  # (m, 2, 3) world
    covariance_m2: F64  # (m, 2, 3, 3) world
    endpoints_px: F64  # (m, 2, 2)
    sigma_px: F64  # (m,) of an end point across the segment
    observed_m: F64  # (m, 2, 3) camera
    observed_covariance_m2: F64  # (m, 2, 3, 3) camera


class PlaneTerms(NamedTuple):
    """p pairs of a world plane and an observed one. Covariances are of (a, b, d), see `types.Planes`."""

    kinds: I32  # (p,) SAME, PARALLEL or PERPENDICULAR
    coefficients: F64  # (p, 4) world
    covariance: F64  # (p, 3, 3)
    observed: F64  # (p, 4) camera
    observed_covariance: F64  # (p, 3, 3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rotation_and_translation(T: F64) -> tuple[F64, F64]:
    """Rotation and translation of T (4, 4)."""
    R, t = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        t[i] = T[i, 3]
        for j in range(3):
            R[i, j] = T[i, j]
    return R, t


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def to_camera(R: F64, t: F64, world: F64, out: F64) -> None:
    """`out = Rᵀ (world - t)`."""
    x, y, z = world[0] - t[0], world[1] - t[1], world[2] - t[2]
    for k in range(3):
        out[k] = R[0, k] * x + R[1, k] * y + R[2, k] * z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def chain_point(D: F64, rows: int, p: F64, J: F64) -> None:
    """J (rows, 6) from the derivatives D (rows, 3) with respect to the camera-frame point p."""
    for k in range(rows):
        a, b, c = D[k, 0], D[k, 1], D[k, 2]
        J[k, 0], J[k, 1], J[k, 2] = -a, -b, -c
        J[k, 3] = b * p[2] - c * p[1]
        J[k, 4] = c * p[0] - a * p[2]
        J[k, 5] = a * p[1] - b * p[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def point_rows(p: F64, pixel: F64, depth_m: float, camera: F64, r: F64, D: F64) -> bool:
    """Reprojection (px) and inverse depth (1/m) of camera-frame point p: residual r (3,) and D = dr/dp (3, 3); without depth the third row is 0.

    The inverse-depth row is the stereo-like row of RGB-D SLAM up to the baseline. False when p is not in front of the camera, or NaN."""
    if not p[2] > NEAR_M:
        return False
    iz = 1.0 / p[2]
    fx, fy = camera[0] * iz, camera[1] * iz
    r[0] = fx * p[0] + camera[2] - pixel[0]
    r[1] = fy * p[1] + camera[3] - pixel[1]
    D[0, 0], D[0, 1], D[0, 2] = fx, 0.0, -fx * p[0] * iz
    D[1, 0], D[1, 1], D[1, 2] = 0.0, fy, -fy * p[1] * iz
    D[2, 0], D[2, 1], D[2, 2], r[2] = 0.0, 0.0, 0.0, 0.0
    if np.isfinite(depth_m):
        r[2] = iz - 1.0 / depth_m
        D[2, 2] = -iz * iz
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def line_row(p: F64, segment_px: F64, camera: F64, D: F64) -> tuple[float, float]:
    """Signed distance (px) of the projection of camera-frame point p from the line through `segment_px` (2, 2), and where along the segment
    it falls (0 = start, 1 = end). D (3,) is the distance's derivative. The line is normalised by √(a² + b²). p must be in front."""
    iz = 1.0 / p[2]
    u, v = camera[0] * p[0] * iz + camera[2], camera[1] * p[1] * iz + camera[3]
    dx, dy = segment_px[1, 0] - segment_px[0, 0], segment_px[1, 1] - segment_px[0, 1]
    length = max(np.sqrt(dx * dx + dy * dy), 1e-9)
    a, b = -dy / length, dx / length
    x, y = u - segment_px[0, 0], v - segment_px[0, 1]
    D[0], D[1] = a * camera[0] * iz, b * camera[1] * iz
    D[2] = -(D[0] * p[0] + D[1] * p[1]) * iz
    return a * x + b * y, (dx * x + dy * y) / (length * length)


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def depth_direction(observed_m: F64, m: F64) -> bool:
    """m (3,): the unit vector normal to an observed 3D segment (2, 3) within the plane through it and the camera centre, the direction the image
    cannot see. False when the segment has NaN or points at the camera."""
    o, e = observed_m[0], observed_m[1]
    dx, dy, dz = e[0] - o[0], e[1] - o[1], e[2] - o[2]
    nx, ny, nz = o[1] * e[2] - o[2] * e[1], o[2] * e[0] - o[0] * e[2], o[0] * e[1] - o[1] * e[0]
    m[0], m[1], m[2] = ny * dz - nz * dy, nz * dx - nx * dz, nx * dy - ny * dx
    size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    if not size > 1e-9:
        return False
    for k in range(3):
        m[k] /= size
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def line_depth_row(p: F64, observed_m: F64, m: F64) -> tuple[float, float]:
    """Distance (m) of camera-frame point p from an observed 3D segment along m (its derivative), and where along the segment it falls."""
    x, y, z = p[0] - observed_m[0, 0], p[1] - observed_m[0, 1], p[2] - observed_m[0, 2]
    dx, dy, dz = observed_m[1, 0] - observed_m[0, 0], observed_m[1, 1] - observed_m[0, 1], observed_m[1, 2] - observed_m[0, 2]
    return m[0] * x + m[1] * y + m[2] * z, (dx * x + dy * y + dz * z) / max(dx * dx + dy * dy + dz * dz, 1e-12)


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def basis(n: F64, B: F64) -> None:
    """B (3, 2): `geometry.tangent_basis` of the unit vector n."""
    s = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    B[0, 0], B[1, 0], B[2, 0] = 1.0 + s * n[0] * n[0] * a, s * b, -s * n[0]
    B[0, 1], B[1, 1], B[2, 1] = b, s + n[1] * n[1] * a, -n[1]


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def plane_rows(kind: int, R: F64, t: F64, world: F64, observed: F64, B: F64, r: F64, J: F64) -> int:
    """Residual r (3,) and J (3, 6) of a plane pair; returns the number of rows. B is `basis` of the observed normal.

    SAME: the predicted normal in the tangent plane of the observed one, and d (3 rows; regular at every normal, unlike azimuth and elevation).
    PARALLEL: the tangent rows alone, for either orientation. PERPENDICULAR: the product of the normals."""
    n0 = R[0, 0] * world[0] + R[1, 0] * world[1] + R[2, 0] * world[2]
    n1 = R[0, 1] * world[0] + R[1, 1] * world[1] + R[2, 1] * world[2]
    n2 = R[0, 2] * world[0] + R[1, 2] * world[1] + R[2, 2] * world[2]
    dot = n0 * observed[0] + n1 * observed[1] + n2 * observed[2]
    for k in range(3):
        for b in range(6):
            J[k, b] = 0.0
    if kind == PERPENDICULAR:
        r[0] = dot
        o0, o1, o2 = observed[0], observed[1], observed[2]
        J[0, 3], J[0, 4], J[0, 5] = o1 * n2 - o2 * n1, o2 * n0 - o0 * n2, o0 * n1 - o1 * n0
        return 1
    sign = -1.0 if kind == PARALLEL and dot < 0.0 else 1.0
    for k in range(2):
        b0, b1, b2 = sign * B[0, k], sign * B[1, k], sign * B[2, k]
        r[k] = b0 * n0 + b1 * n1 + b2 * n2
        J[k, 3], J[k, 4], J[k, 5] = b1 * n2 - b2 * n1, b2 * n0 - b0 * n2, b0 * n1 - b1 * n0  # bᵀ [n]×, when the camera turns
    if kind == PARALLEL:
        return 2
    r[2] = world[3] + world[0] * t[0] + world[1] * t[1] + world[2] * t[2] - observed[3]
    J[2, 0], J[2, 1], J[2, 2] = n0, n1, n2
    return 3


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def plane_slopes(kind: int, R: F64, t: F64, world: F64, observed: F64, Bw: F64, B: F64, F: F64, G: F64) -> None:
    """Derivatives (3, 3) of `plane_rows` by the (a, b, d) of the map plane, F, and of the observed one, G, of bases Bw and B; signs apart."""
    for i in range(3):
        for j in range(3):
            F[i, j] = G[i, j] = 0.0
    if kind == PERPENDICULAR:
        for j in range(2):
            for i in range(3):
                turned = R[i, 0] * observed[0] + R[i, 1] * observed[1] + R[i, 2] * observed[2]
                F[0, j] += turned * Bw[i, j]
                G[0, j] += (R[0, i] * world[0] + R[1, i] * world[1] + R[2, i] * world[2]) * B[i, j]
    else:
        for j in range(2):
            for k in range(2):
                for i in range(3):
                    F[k, j] += B[i, k] * (R[0, i] * Bw[0, j] + R[1, i] * Bw[1, j] + R[2, i] * Bw[2, j])
            G[j, j] = 1.0
            if kind == SAME:
                F[2, j] = t[0] * Bw[0, j] + t[1] * Bw[1, j] + t[2] * Bw[2, j]
        if kind == SAME:
            F[2, 2] = G[2, 2] = 1.0
