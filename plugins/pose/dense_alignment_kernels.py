"""Kernels of `dense_alignment.py`: residuals and Jacobians of warped pixels, their normal equations, and observability."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64
from trihedron.plugins.shared.image_reduction_kernels import EDGE

NEAREST_M = 0.1  # depth below which nothing is projected
STEEPEST = 0.15  # cosine between ray and surface below which a reading is unreliable


class Source(NamedTuple):
    """n points of an image."""

    points_m: F64  # (n, 3)
    normals: F32  # (n, 3), NaN = none
    gray: F64  # (n,)
    sigma_m: F64  # (n,) of their depth


class Target(NamedTuple):
    """The image they are warped into, (h, w)."""

    gray: F32
    gray_x: F32
    gray_y: F32
    depth_m: F32
    normals: F32  # (h, w, 3)
    intrinsics: F64  # (fx, fy, cx, cy)


class Residuals(NamedTuple):
    """Residuals of n points: (brightness, metres across the surface), with Jacobians. `cosine` is -k, 0 for a point that is not seen; `normal` is the
    source's normal in the target's frame where both normals are known, seen or not."""

    r: F64  # (n, 2)
    J: F64  # (n, 2, 6)
    cosine: F64  # (n,)
    normal: F64  # (n, 3), NaN = none


@kernel
def fill_residuals(
    source: Source, target: Target, R: F64, t: F64, least_gradient: float, farthest_m: float, least_cosine: float, residuals: Residuals
) -> None:
    """Compute residuals and Jacobians at a motion R, t.

    A brightness Jacobian needs a gradient of `least_gradient` per pixel, else it is zero: it would be noise. Points farther than `farthest_m` from
    the surface, or whose normals differ beyond `least_cosine`, are not seen."""
    h, w = target.depth_m.shape
    fx, fy, cx, cy = target.intrinsics
    for i in range(len(source.points_m)):
        residuals.cosine[i], residuals.normal[i, 0] = 0.0, np.nan
        p = source.points_m[i]
        x = R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + t[0]
        y = R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + t[1]
        z = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2]
        if not z > NEAREST_M:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (u >= 0.0 and v >= 0.0 and u < w - 1 and v < h - 1):
            continue
        c, r = int(u), int(v)
        a, b = u - c, v - r
        d00, d01, d10, d11 = target.depth_m[r, c], target.depth_m[r, c + 1], target.depth_m[r + 1, c], target.depth_m[r + 1, c + 1]
        low, high = min(d00, d01, d10, d11), max(d00, d01, d10, d11)
        if not low > 0.0 or high - low > EDGE * low:
            continue
        n = target.normals[r + (1 if b > 0.5 else 0), c + (1 if a > 0.5 else 0)]
        k = (n[0] * x + n[1] * y) / z + n[2]
        if not k < -STEEPEST:
            continue
        w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
        off = k * (w00 * d00 + w01 * d01 + w10 * d10 + w11 * d11 - z)
        if abs(off) > farthest_m:
            continue
        _across(-n[0], -n[1], -n[2], x, y, z, residuals.J[i, 1])
        m = source.normals[i]
        facing = 0.0
        for j in range(3):
            residuals.normal[i, j] = R[j, 0] * m[0] + R[j, 1] * m[1] + R[j, 2] * m[2]
            facing += n[j] * residuals.normal[i, j]
        if least_cosine > -1.0 and not facing > least_cosine:
            continue
        residuals.cosine[i], residuals.r[i, 1] = -k, off
        gx = w00 * target.gray_x[r, c] + w01 * target.gray_x[r, c + 1] + w10 * target.gray_x[r + 1, c] + w11 * target.gray_x[r + 1, c + 1]
        gy = w00 * target.gray_y[r, c] + w01 * target.gray_y[r, c + 1] + w10 * target.gray_y[r + 1, c] + w11 * target.gray_y[r + 1, c + 1]
        gray = w00 * target.gray[r, c] + w01 * target.gray[r, c + 1] + w10 * target.gray[r + 1, c] + w11 * target.gray[r + 1, c + 1]
        residuals.r[i, 0] = gray - source.gray[i]
        if gx * gx + gy * gy < least_gradient * least_gradient:
            gx, gy = 0.0, 0.0
        ax, ay = gx * fx / z, gy * fy / z
        _across(ax, ay, -(ax * x + ay * y) / z, x, y, z, residuals.J[i, 0])


@kernel(inline="always")
def _across(ax: float, ay: float, az: float, x: float, y: float, z: float, J: F64) -> None:
    """Jacobian `(a, p' × a)` of a residual with gradient a at p'."""
    J[0], J[1], J[2] = ax, ay, az
    J[3], J[4], J[5] = y * az - z * ay, z * ax - x * az, x * ay - y * ax


@kernel
def normal_equations(residuals: Residuals, W: F64) -> tuple[F64, F64]:
    """H (6, 6) and g (6,) of half the squared error; W (n, 3) holds the weights of brightness², of their product, and of distance²."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    for i in range(len(W)):
        if residuals.cosine[i] == 0.0:
            continue
        a, b, c = W[i]
        e0, e1 = a * residuals.r[i, 0] + b * residuals.r[i, 1], b * residuals.r[i, 0] + c * residuals.r[i, 1]
        for j in range(6):
            p, q = residuals.J[i, 0, j], residuals.J[i, 1, j]
            g[j] += p * e0 + q * e1
            s0, s1 = a * p + b * q, b * p + c * q
            for k in range(j + 1):
                H[j, k] += s0 * residuals.J[i, 0, k] + s1 * residuals.J[i, 1, k]
    for j in range(6):
        for k in range(j):
            H[k, j] = H[j, k]
    return H, g


@kernel
def observability(residuals: Residuals, W: F64) -> tuple[F64, F64, int]:
    """Mean of n mᵀ over the normals n of the target and m of the source at one place (3, 3), the information of the brightness about the
    translation (3, 3), and the number of points seen.

    The noise of the two normals is independent and cancels in the product, also for normals that do not face each other; in the mean of n nᵀ it would
    spread the normals of a wall, and a direction along it would seem observed."""
    N, G, count, pairs = np.zeros((3, 3)), np.zeros((3, 3)), 0, 0
    for i in range(len(W)):
        if not np.isnan(residuals.normal[i, 0]):
            pairs += 1
            for j in range(3):
                for k in range(3):
                    N[j, k] -= 0.5 * (residuals.J[i, 1, j] * residuals.normal[i, k] + residuals.J[i, 1, k] * residuals.normal[i, j])
        if residuals.cosine[i] != 0.0:
            count += 1
            for j in range(3):
                for k in range(3):
                    G[j, k] += W[i, 0] * residuals.J[i, 0, j] * residuals.J[i, 0, k]
    return N / max(pairs, 1), G, count
