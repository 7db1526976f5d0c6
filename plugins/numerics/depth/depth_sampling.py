"""Depth at sub-pixel positions, refused where it cannot be trusted."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, DepthNoise


def noise_coefficients(noise: DepthNoise) -> tuple[float, float, float, float]:
    """The depth noise model as numbers a kernel can take: (a, b, c, floor) of `max(floor, a + b z + c z²)`."""
    return float(noise.a_m), float(noise.b), float(noise.c_per_m), float(noise.floor_m)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sigma_z(z: float, noise: tuple[float, float, float, float]) -> float:
    """Standard deviation of a depth reading z, metres."""
    a, b, c, floor = noise
    return max(floor, a + b * z + c * z * z)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def local_depth(
    depth: F32, pixels: F32, radius: int, share: float, noise: tuple[float, float, float, float], gate: float, edge: float
) -> tuple[F32, F32]:
    """Depth at (n, 2) pixels and its standard deviation, both (n,) float32, NaN where it is not to be trusted.

    A linear surface is fitted to the (2 radius + 1)² neighbourhood, of which at least `share` must have depth. When all of it lies within `gate` σ_z
    of the fit, that is the depth. When some is off by less than `edge · z` more (a crease), the mean of the nearest pixels is, and σ grows.
    Else it is a depth edge."""
    out = np.full(len(pixels), np.nan, np.float32)
    sigma = np.full(len(pixels), np.nan, np.float32)
    least = max(share * (2 * radius + 1) ** 2, 3.0)
    for i in range(len(pixels)):
        u, v = float(pixels[i, 0]), float(pixels[i, 1])
        if not (abs(u) < 1e6 and abs(v) < 1e6):
            continue
        n, z, worst = _linear_fit(depth, u, v, radius)
        if n < least or z <= 0.0:
            continue
        s = sigma_z(z, noise)
        if worst <= gate * s:
            out[i], sigma[i] = z, s
        elif worst <= gate * s + edge * z:
            near, close, _ = _nearest_mean(depth, u, v)
            if near > 0:
                out[i], sigma[i] = close, np.sqrt(s * s + (close - z) ** 2)
    return out, sigma


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _linear_fit(depth: F32, u: float, v: float, radius: int) -> tuple[int, float, float]:
    """Count, value at (u, v) and largest residual of the least-squares linear surface through the neighbourhood's depths."""
    rows, cols = depth.shape
    x, y = int(np.rint(u)), int(np.rint(v))
    x0, x1, y0, y1 = max(x - radius, 0), min(x + radius + 1, cols), max(y - radius, 0), min(y + radius + 1, rows)
    n, sx, sy, sxx, sxy, syy, sz, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(y0, y1):
        for c in range(x0, x1):
            z = float(depth[r, c])
            if 0.0 < z < np.inf:
                a, b = c - u, r - v
                n += 1.0
                sx += a
                sy += b
                sxx += a * a
                sxy += a * b
                syy += b * b
                sz += z
                sxz += a * z
                syz += b * z
    if n < 3.0:
        return int(n), 0.0, np.inf
    cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
    cxz, cyz = sxz - sx * sz / n, syz - sy * sz / n
    det = cxx * cyy - cxy * cxy
    if det < 1e-6:
        return 0, 0.0, np.inf
    gx, gy = (cyy * cxz - cxy * cyz) / det, (cxx * cyz - cxy * cxz) / det
    z0 = (sz - gx * sx - gy * sy) / n
    worst = 0.0
    for r in range(y0, y1):
        for c in range(x0, x1):
            z = float(depth[r, c])
            if 0.0 < z < np.inf:
                worst = max(worst, abs(z - z0 - gx * (c - u) - gy * (r - v)))
    return int(n), z0, worst


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _nearest_mean(depth: F32, u: float, v: float) -> tuple[float, float, float]:
    """Weight, bilinear mean and spread of the (up to four) depths around (u, v)."""
    rows, cols = depth.shape
    x, y = int(np.floor(u)), int(np.floor(v))
    weight, mean, low, high = 0.0, 0.0, np.inf, 0.0
    for r in range(max(y, 0), min(y + 2, rows)):
        for c in range(max(x, 0), min(x + 2, cols)):
            z = float(depth[r, c])
            if 0.0 < z < np.inf:
                w = (1.0 - abs(c - u)) * (1.0 - abs(r - v))
                weight += w
                mean += w * z
                low, high = min(low, z), max(high, z)
    if weight < 1e-6:
        return 0.0, 0.0, 0.0
    return weight, mean / weight, high - low
