"""Numba kernels of `mean_shift.py`: mean shift of axes on the unit sphere, antipodes being one, and the search for axes to start from.

Directions are (n, 3) unit rows with (n,) weights. Axes are the columns of a (3, m) matrix; those found by mean shift are unit but only nearly at
right angles."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, Bool
from trihedron.plugins.manhattan.axis_fit_kernels import orthonormal
from trihedron.plugins.manhattan.mode_verification_kernels import ModeLimits, verify_modes_kernel

BINS = 90  # one degree each, of a quarter turn


class ShiftLimits(NamedTuple):
    """Options of mean shift that `modes.track_modes` converts to rad."""

    cone: float
    bandwidth: float
    max_iterations: int
    tolerance: float


@kernel
def track_modes_kernel(
    vectors: F64, weights: F64, first: int, start: F64, shift: ShiftLimits, planes: F64, limits: ModeLimits
) -> tuple[F64, F64, F64, Bool, bool]:
    """Return the fields of `Modes` by mean shift from the axes `start` (3, 3); axes that are no modes stay there."""
    cone, bandwidth, iterations, tolerance = shift
    axes = shift_axes(vectors, weights, start, cone, bandwidth, iterations, tolerance)
    normals = mode_statistics(vectors[:first], weights[:first], axes, cone)
    lines = mode_statistics(vectors[first:], weights[first:], axes, cone)
    seen, supported = verify_modes_kernel(vectors, weights, first, axes, normals, lines, planes, limits)
    for k in range(3):
        if not seen[k]:
            for j in range(3):
                axes[j, k] = start[j, k]
    return axes, normals, lines, seen, supported


@kernel
def shift_axes(directions: F64, weights: F64, axes: F64, cone: float, bandwidth: float, iterations: int, tolerance: float) -> F64:
    """Move each of m axes (3, m) to the Gaussian-weighted mean of the directions within `cone` (rad) of it, in its tangent plane, until none moves by
    more than `tolerance` (rad). A direction goes to its nearest axis only; an axis without directions stays. Returns the axes (Zhou et al. 2016)."""
    axes = axes.copy()
    floor, narrow = np.cos(cone), -0.5 / (bandwidth * bandwidth)
    total = np.empty((axes.shape[1], 4))
    for _ in range(iterations):
        total[:] = 0.0
        for i in range(len(directions)):
            x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
            best, dot = 0, 0.0
            for k in range(axes.shape[1]):
                d = x * axes[0, k] + y * axes[1, k] + z * axes[2, k]
                if abs(d) > abs(dot):
                    best, dot = k, d
            if abs(dot) < floor:
                continue
            # (1 - dot²) is the squared length in the tangent plane
            w = weights[i] * np.exp(narrow * max(1.0 - dot * dot, 0.0))
            total[best, 3] += w
            w = w if dot > 0.0 else -w
            total[best, 0] += w * x
            total[best, 1] += w * y
            total[best, 2] += w * z
        moved = 0.0
        for k in range(axes.shape[1]):
            if total[k, 3] <= 0.0:
                continue
            norm = np.sqrt(total[k, 0] ** 2 + total[k, 1] ** 2 + total[k, 2] ** 2)
            step = 0.0
            for j in range(3):
                step += (total[k, j] / norm - axes[j, k]) ** 2
                axes[j, k] = total[k, j] / norm
            moved = max(moved, step)
        if moved < tolerance * tolerance:
            break
    return axes


@kernel
def mode_statistics(directions: F64, weights: F64, axes: F64, cone: float) -> F64:
    """(m, 4) for each of m axes (3, m): number and weight of the directions within the cone which have none nearer, their mean squared angle (rad²),
    and the mean square of its component across the axis where that is largest. Without order the latter is cone² / 4, and cone² / 3 when all
    directions lie in one plane."""
    count = axes.shape[1]
    out, moments, basis = np.zeros((count, 4)), np.zeros((count, 3)), np.empty((count, 6))
    for k in range(count):
        basis[k, 0], basis[k, 1], basis[k, 2], basis[k, 3], basis[k, 4], basis[k, 5] = _across(axes[0, k], axes[1, k], axes[2, k])
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        best, nearest = np.cos(cone), -1
        for k in range(count):
            dot = abs(x * axes[0, k] + y * axes[1, k] + z * axes[2, k])
            if dot > best:
                best, nearest = dot, k
        if nearest >= 0:
            b, w = basis[nearest], weights[i]
            p, q = x * b[0] + y * b[1] + z * b[2], x * b[3] + y * b[4] + z * b[5]
            out[nearest, 0] += 1.0
            out[nearest, 1] += w
            moments[nearest, 0] += w * p * p
            moments[nearest, 1] += w * p * q
            moments[nearest, 2] += w * q * q
    for k in range(count):
        if out[k, 1] > 0.0:
            uu, uv, vv = moments[k]
            out[k, 2] = (uu + vv) / out[k, 1]
            out[k, 3] = 0.5 * (uu + vv + np.sqrt((uu - vv) ** 2 + 4.0 * uv * uv)) / out[k, 1]
    return out


@kernel
def _across(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors at right angles to the unit vector (x, y, z) and to each other."""
    if abs(x) < 0.7:
        norm = np.sqrt(y * y + z * z)
        u = (0.0, z / norm, -y / norm)
    else:
        norm = np.sqrt(x * x + z * z)
        u = (-z / norm, 0.0, x / norm)
    return u[0], u[1], u[2], y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]


# Search from everywhere: no axes to start from are known.


@kernel
def search_axes(directions: F64, weights: F64, starts: F64, cone: float, bandwidth: float, primaries: int, turns: int) -> F64:
    """Find the three orthogonal axes of greatest density: each of the `primaries` densest directions with its `turns` fullest turns about it
    is refined and compared. `starts` (m, 3) are directions spread over the half sphere, less than a cone apart. (3, 3) rotation."""
    best, found, alone = -1.0, np.eye(3), np.empty((3, 1))
    chosen = densest(directions, weights, starts, cone, primaries)
    for i in range(len(chosen)):
        for k in range(3):
            alone[k, 0] = chosen[i, k]
        frame = right_handed(shift_axes(directions, weights, alone, cone, bandwidth, np.int64(10), 1e-3)[:, 0])
        for turn in _quarter_turns(_histogram(directions, weights, frame, cone), turns):
            c, s = np.cos(turn), np.sin(turn)
            R = frame.copy()
            for k in range(3):
                R[k, 1], R[k, 2] = c * frame[k, 1] + s * frame[k, 2], c * frame[k, 2] - s * frame[k, 1]
            axes = shift_axes(directions, weights, R, cone, bandwidth, np.int64(5), 1e-3)
            R = orthonormal(axes, np.sqrt(mode_statistics(directions, weights, axes, cone)[:, 1]) + 1e-9)
            score = density(directions, weights, R, bandwidth)
            if score > best:
                best, found = score, R
    return found


@kernel
def densest(directions: F64, weights: F64, starts: F64, cone: float, count: int) -> F64:
    """Select from `starts` (m, 3) those with most weight within the cone, at least two cones apart; at most `count`, heaviest first."""
    mass, chosen, apart = _mass(directions, weights, starts, cone), np.empty((count, 3)), np.cos(2.0 * cone)
    for n in range(count):
        best = np.argmax(mass)
        if mass[best] <= 0.0:
            return chosen[:n]
        for k in range(3):
            chosen[n, k] = starts[best, k]
        for s in range(len(starts)):
            if abs(starts[s, 0] * chosen[n, 0] + starts[s, 1] * chosen[n, 1] + starts[s, 2] * chosen[n, 2]) > apart:
                mass[s] = 0.0
    return chosen


@kernel
def _mass(directions: F64, weights: F64, starts: F64, cone: float) -> F64:
    """(m,) weight of the directions within the cone of each start, falling off towards its rim."""
    mass, floor = np.zeros(len(starts)), np.cos(cone)
    for s in range(len(starts)):
        for i in range(len(directions)):
            dot = abs(directions[i, 0] * starts[s, 0] + directions[i, 1] * starts[s, 1] + directions[i, 2] * starts[s, 2])
            if dot > floor:
                mass[s] += weights[i] * (dot - floor)
    return mass


@kernel
def _histogram(directions: F64, weights: F64, frame: F64, cone: float) -> F64:
    """(BINS,) weight of the directions normal to the first column of `frame` by their turn from its second to its third, modulo a quarter turn."""
    histogram, limit = np.zeros(BINS), np.sin(cone)
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        if abs(x * frame[0, 0] + y * frame[1, 0] + z * frame[2, 0]) < limit:
            angle = np.arctan2(x * frame[0, 2] + y * frame[1, 2] + z * frame[2, 2], x * frame[0, 1] + y * frame[1, 1] + z * frame[2, 1])
            histogram[int(np.floor(angle * BINS / (0.5 * np.pi))) % BINS] += weights[i]
    return histogram


@kernel
def _quarter_turns(histogram: F64, count: int) -> F64:
    """(count,) the fullest turns (rad, modulo a quarter turn), 10° apart."""
    smooth, turns = np.zeros(BINS), np.empty(count)
    for i in range(BINS):
        for k in range(-4, 5):
            smooth[i] += (5 - abs(k)) * histogram[(i - k) % BINS]
    for t in range(count):
        best = int(np.argmax(smooth))
        turns[t] = (best + 0.5) * 0.5 * np.pi / BINS
        for k in range(best - 10, best + 11):
            smooth[k % BINS] = 0.0
    return turns


@kernel
def right_handed(first: F64) -> F64:
    """(3, 3) rotation whose first column is the unit vector `first`."""
    across = _across(first[0], first[1], first[2])
    out = np.empty((3, 3))
    for k in range(3):
        out[k, 0], out[k, 1], out[k, 2] = first[k], across[k], across[3 + k]
    return out


@kernel
def density(directions: F64, weights: F64, axes: F64, bandwidth: float) -> float:
    """Sum of the weights, each times a Gaussian of the angle to its nearest axis."""
    total = 0.0
    for i in range(len(directions)):
        dot = 0.0
        for k in range(3):
            dot = max(dot, abs(directions[i, 0] * axes[0, k] + directions[i, 1] * axes[1, k] + directions[i, 2] * axes[2, k]))
        total += weights[i] * np.exp(-0.5 * max(1.0 - dot * dot, 0.0) / (bandwidth * bandwidth))
    return total
