"""Numba kernels of `ransac.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, Bool
from trihedron.plugins.shared.depth_image_kernels import sigma_z

# 3D lines from image segments and depth.
#
# A 3D line seen by the camera lies in the plane of its image line, and along the image its inverse depth is linear: `1 / z = a + b t`, t the distance
# in pixels along the segment. So the robust line fit has two unknowns, and a sample's Mahalanobis distance is that of its inverse depth.

STRATA = 8  # hypotheses come from every pair of 8 stretches of the segment: 28 of them, no randomness


@kernel
def lift_segments(
    depth: F32,
    endpoints_px: F32,
    intrinsics: tuple[float, float, float, float],
    noise: tuple[float, float, float, float],
    most: int,
    side_px: int,
    edge: float,
    gate: float,
    share: float,
    least: int,
    sigma_px: float,
    independent: float,
    bias: float,
) -> tuple[F32, F32]:
    """End points (n, 2, 3) in the camera frame and their covariances (n, 2, 3, 3) of image segments (n, 2, 2); NaN without a 3D line.

    At most `most` samples a segment, each with the depth of the nearer surface within `side_px` across the segment (surfaces are parted by steps
    above `gate` σ_z + `edge` z). The line with most samples within `gate` σ is refitted by weighted least squares, and accepted with `least` inliers
    that are at least `share` of the samples with depth. One sample in `independent` counts in the covariance, `bias` σ_z is common to all."""
    n = len(endpoints_px)
    points = np.full((n, 2, 3), np.nan, np.float32)
    covariance = np.full((n, 2, 3, 3), np.nan, np.float32)
    fx, fy, cx, cy = intrinsics
    t, rho, sigma = np.empty(most), np.empty(most), np.empty(most)
    inlier, profile = np.empty(most, np.bool_), np.empty(2 * side_px + 1)
    for i in range(n):
        x0, y0, x1, y1 = endpoints_px[i, 0, 0], endpoints_px[i, 0, 1], endpoints_px[i, 1, 0], endpoints_px[i, 1, 1]
        length = np.hypot(x1 - x0, y1 - y0)
        if not 1.0 < length < 1e6:
            continue
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        count = min(int(length) + 1, most)
        m = 0
        for k in range(count):
            s = length * k / (count - 1.0)
            z, error, shift = _sample(depth, x0 + s * ux, y0 + s * uy, ux, uy, noise, gate, edge, profile)
            if z > 0.0:
                t[m], rho[m], sigma[m] = s + shift, 1.0 / z, error / (z * z)
                m += 1
        if m < least:
            continue
        a, b, found = _best_line(t[:m], rho[:m], sigma[:m], gate)
        if found < least or found < share * m:
            continue
        a, b, found, c = _refit(t[:m], rho[:m], sigma[:m], a, b, gate, inlier[:m])
        if found < least or found < share * m:
            continue
        first, last = 0, m - 1
        while not inlier[first]:
            first += 1
        while not inlier[last]:
            last -= 1
        if a + b * t[first] <= 0.0 or a + b * t[last] <= 0.0:
            continue
        for e in range(2):
            s = t[first] if e == 0 else t[last]
            z = 1.0 / (a + b * s)
            rx, ry = (x0 + s * ux - cx) / fx, (y0 + s * uy - cy) / fy
            variance = (c[0] + 2.0 * s * c[1] + s * s * c[2]) * max(independent * (count - 1.0) / length, 1.0)
            variance += (bias * sigma_z(z, noise) / (z * z)) ** 2
            points[i, e, 0], points[i, e, 1], points[i, e, 2] = rx * z, ry * z, z
            _point_covariance(rx, ry, z, variance * z**4, (sigma_px * z / fx) ** 2, covariance[i, e])
    return points, covariance


@kernel
def _point_covariance(rx: float, ry: float, z: float, along: float, across: float, out: F32) -> None:
    """Covariance of the point z (rx, ry, 1): variance `along` of z on the ray, `across` in each direction normal to it."""
    ray = (rx, ry, 1.0)
    norm2 = rx * rx + ry * ry + 1.0
    for j in range(3):
        for k in range(3):
            out[j, k] = ray[j] * ray[k] * (along - across / norm2) + (across if j == k else 0.0)


@kernel
def _sample(
    depth: F32, x: float, y: float, ux: float, uy: float, noise: tuple[float, float, float, float], gate: float, edge: float, profile: F64
) -> tuple[float, float, float]:
    """Depth of the nearer surface at (x, y) on a segment of direction (ux, uy), its standard deviation, and where it was read along the segment
    (px from (x, y)). A depth of 0 means none.

    On a smooth surface depth is interpolated, on a border read from the nearest pixel; being off the line by a part of a pixel adds to the error."""
    _depths_across(depth, x, y, -uy, ux, profile)
    z, offset, slope = _nearer_surface(profile, noise, gate, edge)
    if z <= 0.0:
        return 0.0, 0.0, 0.0
    s = sigma_z(z, noise)
    if offset == 0:
        near, between, spread = _interpolate_depth(depth, x, y)
        if near and spread <= gate * s + edge * z:
            return between, np.sqrt(s * s + (0.3 * slope) ** 2), 0.0
    px, py = x - offset * uy, y + offset * ux
    shift = (np.rint(px) - px) * ux + (np.rint(py) - py) * uy
    return z, np.sqrt(s * s + ((0.5 + 0.5 * abs(offset)) * slope) ** 2), shift


@kernel
def _interpolate_depth(depth: F32, x: float, y: float) -> tuple[bool, float, float]:
    """Return True if the four depths around (x, y) exist, their bilinear value, and their spread."""
    c, r = int(np.floor(x)), int(np.floor(y))
    if not ((c >= 0) & (c < depth.shape[1] - 1) & (r >= 0) & (r < depth.shape[0] - 1)):
        return False, 0.0, 0.0
    a, b, d, e = float(depth[r, c]), float(depth[r, c + 1]), float(depth[r + 1, c]), float(depth[r + 1, c + 1])
    low, high = min(min(a, b), min(d, e)), max(max(a, b), max(d, e))
    if not ((a > 0.0) & (b > 0.0) & (d > 0.0) & (e > 0.0) & (high < np.inf)):
        return False, 0.0, 0.0
    u, v = x - c, y - r
    return True, (a * (1.0 - u) + b * u) * (1.0 - v) + (d * (1.0 - u) + e * u) * v, high - low


@kernel
def _depths_across(depth: F32, x: float, y: float, nx: float, ny: float, out: F64) -> None:
    """Depths (2 reach + 1,) of the pixels nearest to (x, y) + k (nx, ny), k = -reach … reach; 0 outside and where there is none."""
    reach = len(out) // 2
    h, w = depth.shape
    for k in range(-reach, reach + 1):
        c, r, z = int(np.rint(x + k * nx)), int(np.rint(y + k * ny)), 0.0
        if (c >= 0) & (c < w) & (r >= 0) & (r < h):
            z = float(depth[r, c])
        out[k + reach] = z if 0.0 < z < np.inf else 0.0


@kernel
def _nearer_surface(depths: F64, noise: tuple[float, float, float, float], gate: float, edge: float) -> tuple[float, int, float]:
    """Depth of the nearest surface that shows in a profile (2 reach + 1,) of depths across the line, 1 px apart; 0 when there is none.

    The profile is parted into runs without a step; of the runs with two depths or more the nearest to the camera counts, at its place closest to the
    middle. Returns the depth there, the place (px from the middle) and the run's slope (m per px, absolute)."""
    reach = len(depths) // 2
    steps = not depths[0] > 0.0
    for i in range(2 * reach):
        low = min(depths[i + 1], depths[i])
        steps |= (low <= 0.0) | (abs(depths[i + 1] - depths[i]) > gate * sigma_z(low, noise) + edge * low)
    if not steps:  # most often
        return depths[reach], 0, abs(depths[2 * reach] - depths[0]) / max(2 * reach, 1)
    best, best_offset, best_slope = 0.0, 0, 0.0
    run, closest, offset, first, start, previous, last = 0, 0.0, 0, 0.0, 0, 0.0, 0
    for k in range(-reach, reach + 2):
        value = depths[k + reach] if k <= reach else 0.0
        if k <= reach and value == 0.0:
            continue
        step = gate * sigma_z(min(value, previous), noise) + edge * min(value, previous)
        if run > 0 and (k > reach or abs(value - previous) > step):
            if (run >= 2 or reach == 0) and (best == 0.0 or closest < best):
                best, best_offset = closest, offset
                best_slope = abs(previous - first) / max(last - start, 1)
            run = 0
        if run == 0:
            first, start, closest, offset = value, k, value, k
        elif abs(k) < abs(offset):
            closest, offset = value, k
        run += 1
        previous, last = value, k
    return best, best_offset, best_slope


@kernel
def _best_line(t: F64, rho: F64, sigma: F64, gate: float) -> tuple[float, float, int]:
    """The line rho = a + b t with most samples within `gate` sigma, of those through the medians of two stretches of the segment."""
    n = len(t)
    strata = min(STRATA, n // 2)
    ts, rs = np.empty(strata), np.empty(strata)
    for k in range(strata):
        low, high = n * k // strata, n * (k + 1) // strata
        j = low + _median_place(rho[low:high])
        ts[k], rs[k] = t[j], rho[j]
    best, best_a, best_b = 0, 0.0, 0.0
    for p in range(strata):
        for q in range(p + 1, strata):
            if ts[q] - ts[p] < 1e-6:
                continue
            b = (rs[q] - rs[p]) / (ts[q] - ts[p])
            a = rs[p] - b * ts[p]
            found = 0
            for k in range(n):
                found += abs(rho[k] - a - b * t[k]) < gate * sigma[k]
            if found > best:
                best, best_a, best_b = found, a, b
    return best_a, best_b, best


@kernel
def _median_place(values: F64) -> int:
    """Index of the (upper) median of a handful of values, the first of equals."""
    n = len(values)
    for i in range(n):
        below, equal = 0, 0
        for k in range(n):
            below += values[k] < values[i]
            equal += values[k] == values[i]
        if below <= n // 2 < below + equal:
            return i
    return 0


@kernel
def _refit(t: F64, rho: F64, sigma: F64, a: float, b: float, gate: float, inlier: Bool) -> tuple[float, float, int, tuple[float, float, float]]:
    """Weighted least squares on the inliers of (a, b), twice; marks the inliers and returns (a, b), their number and the covariance (aa, ab, bb)."""
    found = 0
    caa, cab, cbb = 0.0, 0.0, 0.0
    for _ in range(3):
        s, st, stt, sr, str_ = 0.0, 0.0, 0.0, 0.0, 0.0
        found = 0
        for k in range(len(t)):
            inlier[k] = abs(rho[k] - a - b * t[k]) < gate * sigma[k]
            if inlier[k]:
                w = 1.0 / (sigma[k] * sigma[k])
                found += 1
                s += w
                st += w * t[k]
                stt += w * t[k] * t[k]
                sr += w * rho[k]
                str_ += w * t[k] * rho[k]
        det = s * stt - st * st
        if found < 2 or det <= 1e-12 * s * stt:
            return a, b, 0, (0.0, 0.0, 0.0)
        a, b = (stt * sr - st * str_) / det, (s * str_ - st * sr) / det
        caa, cab, cbb = stt / det, -st / det, s / det
    return a, b, found, (caa, cab, cbb)
