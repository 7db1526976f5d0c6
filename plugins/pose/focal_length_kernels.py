"""Numba kernels of `focal_length.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.linalg_kernels import polar_rotation, solve_positive, turn_left

# What keyframes say of the focal lengths they were told: seen from two sides, points keep their distances only under the right ones.
#
# A point stands at `((u - cx) / f, (v - cy) / f, 1) · depth`. Under wrong focal lengths the same points are squeezed along other directions in each
# view, and no rigid motion takes one view to the other. So the keyframes' own measurements, whatever their poses, say by which factor `f` is wrong.

KEYFRAMES, LEAST_POINTS, LEAST_PAIRS, MOST_POINTS = 8, 30, 3, 100
PIXEL = 1.0  # standard deviation of a point, px
CUT = 3.0  # standard deviations at which a point counts half (Geman and McClure)
ROW_BITS, VIEW_BITS = 20, 51  # of a number that is sorted by view, id and row


@kernel
def places_kernel(views: NDArray[np.int64], pixels: F32, depths_m: F32, sigmas_m: F32, intrinsics: F64) -> F64:
    """(n, 5) measurements of `_measured`, of what the `views` (n,) with intrinsics (k, 4) saw at pixels (n, 2)."""
    out = np.empty((len(views), 5))
    for i in range(len(views)):
        view, depth = views[i], float(depths_m[i])
        fx, fy, cx, cy = intrinsics[view, 0], intrinsics[view, 1], intrinsics[view, 2], intrinsics[view, 3]
        out[i, 0], out[i, 1], out[i, 2] = (pixels[i, 0] - cx) / fx * depth, (pixels[i, 1] - cy) / fy * depth, depth
        out[i, 3], out[i, 4] = sigmas_m[i], PIXEL * depth / fx
    return out


@kernel
def totals_kernel(order: NDArray[np.int64], ids: I32, seen: F64, factors: F64) -> tuple[F64, int]:
    """What the best rigid motions between the views leave under focal lengths that are by these factors as long, and how many pairs of views saw
    enough of the same points."""
    rows, starts = _distinct(order, seen)
    views = len(starts) - 1
    totals, pairs = np.zeros(len(factors)), 0
    left, right = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
    for a in range(views):
        for b in range(a + 1, views):
            shared, i, j = 0, starts[a], starts[b]
            while i < starts[a + 1] and j < starts[b + 1]:
                one, other = ids[rows[i]], ids[rows[j]]
                if one == other:
                    left[shared], right[shared] = rows[i], rows[j]
                    shared += 1
                i, j = i + (one <= other), j + (other <= one)
            if shared < LEAST_POINTS:
                continue
            every, pairs = -(-shared // MOST_POINTS), pairs + 1
            p, q = np.empty((-(-shared // every), 5)), np.empty((-(-shared // every), 5))
            for k in range(len(p)):
                for c in range(5):
                    p[k, c], q[k, c] = seen[left[k * every], c], seen[right[k * every], c]
            for k in range(len(factors)):
                totals[k] += _cost(p, q, factors[k])
    return totals, pairs


@kernel
def _distinct(order: NDArray[np.int64], seen: F64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first row with depth of each point of each view, by views and ids, and where the views' rows begin and the last one's end."""
    views = (order[-1] >> VIEW_BITS) + 1 if len(order) else 0
    rows, starts, count, last = np.empty(len(order), np.int64), np.zeros(views + 1, np.int64), 0, -1
    for number in order:
        row, point = number & ((1 << ROW_BITS) - 1), number >> ROW_BITS
        if point != last and np.isfinite(seen[row, 2]):
            rows[count], last = row, point
            count += 1
            starts[(number >> VIEW_BITS) + 1] = count
    for view in range(views):  # of views without any
        starts[view + 1] = max(starts[view + 1], starts[view])
    return rows, starts


@kernel
def _cost(a: F64, b: F64, factor: float) -> float:
    """Robust cost, 0 to 1, of the best rigid motion (Procrustes, reweighted) between n points measured twice, (n, 5) as of `_measured`."""
    n = len(a)
    p, q, sigma, weight, cost = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n), 0.0
    for k in range(n):
        p[k, 0], p[k, 1], p[k, 2] = a[k, 0] / factor, a[k, 1] / factor, a[k, 2]
        q[k, 0], q[k, 1], q[k, 2] = b[k, 0] / factor, b[k, 1] / factor, b[k, 2]
        sigma[k] = math.sqrt(a[k, 3] ** 2 + b[k, 3] ** 2 + (a[k, 4] ** 2 + b[k, 4] ** 2) / factor**2)
        weight[k] = 1.0 / sigma[k] ** 2
    S = np.empty((3, 3))
    for _ in range(3):
        total, p0, p1, p2, q0, q1, q2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            total += weight[k]
        for k in range(n):
            weight[k] /= total
            w = weight[k]
            p0, p1, p2 = p0 + w * p[k, 0], p1 + w * p[k, 1], p2 + w * p[k, 2]
            q0, q1, q2 = q0 + w * q[k, 0], q1 + w * q[k, 1], q2 + w * q[k, 2]
        s00, s01, s02, s10, s11, s12, s20, s21, s22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            w, x, y, z = weight[k], q[k, 0] - q0, q[k, 1] - q1, q[k, 2] - q2
            u, v, w = w * (p[k, 0] - p0), w * (p[k, 1] - p1), w * (p[k, 2] - p2)
            s00, s01, s02 = s00 + u * x, s01 + u * y, s02 + u * z
            s10, s11, s12 = s10 + v * x, s11 + v * y, s12 + v * z
            s20, s21, s22 = s20 + w * x, s21 + w * y, s22 + w * z
        S[0, 0], S[0, 1], S[0, 2], S[1, 0], S[1, 1], S[1, 2], S[2, 0], S[2, 1], S[2, 2] = s00, s01, s02, s10, s11, s12, s20, s21, s22
        R, cost = polar_rotation(S), 0.0
        for k in range(n):
            u, v, w, left = p[k, 0] - p0, p[k, 1] - p1, p[k, 2] - p2, 0.0
            for c in range(3):
                at = -(q[k, c] - (q0 if c == 0 else q1 if c == 1 else q2)) + u * R[0, c] + v * R[1, c] + w * R[2, c]
                left += at * at
            square = left / (CUT * sigma[k]) ** 2
            cost += square / (1.0 + square)
            weight[k] = 1.0 / (sigma[k] * (1.0 + square)) ** 2
    return cost / n


# What a frame says of the focal lengths it was told: turned by a degree, points a keyframe measured move otherwise under wrong ones.
#
# A turn by θ moves a point at depth z by θ z across and by θ x in depth. Under focal lengths that are wrong by a factor the one is stretched and the
# other squeezed, so that no rigid motion is both. The factor is one more unknown of the motion, found with its standard deviation: at first, before
# the camera has turned, it is anything, and after some degrees it is known to a few per cent. Until then the motion is known only as well as the
# factor is: its covariance is the marginal one over the factor, of which a camera's calibration says something beforehand.

PRIOR = 0.5  # standard deviation of the factor's logarithm before anything is seen
CUT2 = 9.0  # squared standard deviations at which a point counts a quarter (Geman and McClure)
STEPS = 4  # of Gauss and Newton, from a pose that is nearly right


@kernel
def solve(before: F64, seen: F64, noise_px: F64, noise_m: F64, told: F64, R: F64, t: F64) -> tuple[float, float, F64, F64]:
    """The factor, the deviation of its logarithm, and how that turns and shifts (3,) the motion, from places (n, 3) seen again at pixels and depths
    (n, 3) after the motion R, t, or nearly, which is made exact."""
    H, g, J, Jp, x = np.zeros((7, 7)), np.zeros(7), np.zeros((3, 7)), np.zeros((3, 3)), np.zeros(7)
    e, log_factor = np.zeros(3), 0.0
    for _ in range(STEPS):
        for a in range(7):
            g[a] = 0.0
            for b in range(7):
                H[a, b] = 0.0
        squeeze = np.exp(-log_factor)
        fx, fy = told[0] / squeeze, told[1] / squeeze
        for k in range(len(before)):
            a0, a1, a2 = squeeze * before[k, 0], squeeze * before[k, 1], before[k, 2]
            s0, s1, s2 = R[0, 0] * a0 + R[0, 1] * a1, R[1, 0] * a0 + R[1, 1] * a1, R[2, 0] * a0 + R[2, 1] * a1
            q0, q1, q2 = s0 + R[0, 2] * a2, s1 + R[1, 2] * a2, s2 + R[2, 2] * a2
            X, Y, z = q0 + t[0], q1 + t[1], q2 + t[2]
            u, v = fx * X / z, fy * Y / z
            e[0], e[1], e[2] = seen[k, 0] - told[2] - u, seen[k, 1] - told[3] - v, seen[k, 2] - z
            Jp[0, 0], Jp[0, 2], Jp[1, 1], Jp[1, 2], Jp[2, 2] = fx / z, -u / z, fy / z, -v / z, 1.0
            for i in range(3):
                J[i, 0] = Jp[i, 2] * q1 - Jp[i, 1] * q2  # phi × q
                J[i, 1] = Jp[i, 0] * q2 - Jp[i, 2] * q0
                J[i, 2] = Jp[i, 1] * q0 - Jp[i, 0] * q1
                J[i, 3], J[i, 4], J[i, 5] = Jp[i, 0], Jp[i, 1], Jp[i, 2]
                J[i, 6] = -(Jp[i, 0] * s0 + Jp[i, 1] * s1 + Jp[i, 2] * s2)
            J[0, 6] += u
            J[1, 6] += v
            px, m = 1.0 / noise_px[k], 1.0 / noise_m[k]
            distance = (e[0] * e[0] + e[1] * e[1]) * px + e[2] * e[2] * m
            w = (CUT2 / (CUT2 + distance)) ** 2
            for i in range(3):
                weight = w * (px if i < 2 else m)
                for a in range(7):
                    left = weight * J[i, a]
                    g[a] += left * e[i]
                    for b in range(a + 1):
                        H[a, b] += left * J[i, b]
        for a in range(7):
            for b in range(a):
                H[b, a] = H[a, b]
        H[6, 6] += 1.0 / PRIOR**2
        g[6] -= log_factor / PRIOR**2
        solve_positive(H, g, x)
        turn_left(x, R)
        for i in range(3):
            t[i] += x[3 + i]
        log_factor += x[6]
    for a in range(7):
        g[a] = 1.0 if a == 6 else 0.0
    turned, shifted = np.zeros(3), np.zeros(3)
    if not solve_positive(H, g, x):  # points that say nothing
        return np.exp(log_factor), PRIOR, turned, shifted
    for i in range(3):  # x is the covariance of all unknowns with the factor's logarithm
        turned[i], shifted[i] = x[i] / x[6], x[3 + i] / x[6]
    return np.exp(log_factor), np.sqrt(x[6]), turned, shifted
