"""Numba kernels of `common.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import inverse_positive, polar_rotation, solve_positive
from trihedron.pipeline.core.types import F32, F64, I32, Bool
from trihedron.plugins.shared.lie_kernels import left_multiply_exp
from trihedron.plugins.shared.manhattan_frames_kernels import assign_axes, measured_directions
from trihedron.plugins.shared.sorting_kernels import descending

# From a frame's features to directions on the sphere, and from directions on three axes to a rotation with its covariance.

NOTHING_KNOWN = np.radians(30.0) ** 2  # rad², variance of a rotation that was not measured
BEFOREHAND = 3.0


@kernel
def gathered(normals: F32, ends_m: F32, ends_px: F32, samples: int, per_px: float) -> tuple[F64, F64, int]:
    """The fields of `Directions`."""
    surface = subsample_normals(normals, samples)
    count = len(surface)
    vectors, weights = np.empty((count + len(ends_m), 3)), np.ones(count + len(ends_m))
    vectors[:count] = surface
    n = count
    for i in range(len(ends_m)):
        square, pixels = 0.0, 0.0
        for k in range(3):
            vectors[n, k] = float(ends_m[i, 1, k]) - ends_m[i, 0, k]
            square += vectors[n, k] ** 2
        for k in range(2):
            pixels += (float(ends_px[i, 1, k]) - ends_px[i, 0, k]) ** 2
        if 1e-12 < square < np.inf and np.isfinite(pixels):
            for k in range(3):
                vectors[n, k] /= np.sqrt(square)
            weights[n] = per_px * np.sqrt(pixels)
            n += 1
    return vectors[:n], weights[:n], count


@kernel
def variance_scale(chi2: float, freedom: float) -> float:
    """Scale of the assumed variances by the residuals' χ² with so many degrees of freedom. The assumption counts like BEFOREHAND more: a scene that
    shows little keeps it, one with many planes and edges shows by itself how true its walls are."""
    return (chi2 + BEFOREHAND) / (max(freedom, 0.0) + BEFOREHAND)


class FitOptions(NamedTuple):
    """Options of `AxisFit`, for the kernels; angles in rad."""

    cone: float
    normals_floor: float
    plane_floor: float
    line_floor: float
    use_planes: bool
    use_lines: bool


@kernel
def fitted(
    R: F64, axes: F64, normals: F64, taking_part: Bool, planes: F64, plane_covariance: F64, ends_m: F32, end_covariance: F32,
    rules: FitOptions, gate: float, floor: float,
) -> tuple[F64, F64]:  # fmt: skip
    """`AxisFit` as a kernel."""
    measured, information, on_axis = measured_kernel(R, axes, normals, planes, plane_covariance, ends_m, end_covariance, rules)
    for i in range(len(on_axis)):
        if on_axis[i] >= 0 and not taking_part[on_axis[i]]:
            on_axis[i] = -1
    R, H, chi2, components = fit_rotation(measured, information, on_axis, len(measured) - 3, R, gate, 5)
    scale = variance_scale(chi2, components - 3.0)
    for i in range(3):
        for j in range(3):
            H[i, j] = H[i, j] / scale + (1.0 / NOTHING_KNOWN if i == j else 0.0)
    covariance = inverse_positive(H)
    for i in range(3):
        covariance[i, i] += floor * floor
    return R, covariance


@kernel
def measured_kernel(
    R: F64, axes: F64, normals: F64, planes: F64, plane_covariance: F64, ends_m: F32, end_covariance: F32, rules: FitOptions
) -> tuple[F64, F64, I32]:
    """`AxisFit.measured` as a kernel."""
    p, lines, m = len(planes), len(ends_m), len(normals)
    means, sigma = np.empty((m, 3)), np.empty(m)
    for k in range(m):
        independent = max(normals[k, 0] / NORMALS_PER_SAMPLE, 1.0)
        sigma[k] = np.sqrt(normals[k, 2] / (2.0 * independent) + rules.normals_floor**2)
        for a in range(3):
            means[k, a] = axes[a, k]
    measured, information = measured_directions(planes, plane_covariance, rules.plane_floor, ends_m, end_covariance, rules.line_floor, means, sigma)
    on_axis = assign_axes(measured, R, rules.cone)
    for i in range(len(on_axis)):
        used = rules.use_planes if i < p else rules.use_lines if i < p + lines else normals[i - p - lines, 0] > 0.0
        if not used:
            on_axis[i] = -1
    return measured, information, on_axis


SIGMAS = 2.0  # that a plane may be off


class ModeLimits(NamedTuple):
    """Limits of `ModeFinder`, for the kernels; `widest` is the largest mean square of a mode."""

    cone: float
    min_share: float
    min_lines: int
    min_line_share: float
    widest: float
    min_explained: float
    max_skew: float


@kernel
def surfaces_kernel(planes: F64, covariance: F64, pixels: I32, image: float, cone: float) -> F64:
    """`ModeFinder._surfaces` of those planes (p, 4) that are known; `image` has so many pixels."""
    out, n = np.empty((len(planes), 5)), 0
    for i in range(len(planes)):
        variance = covariance[i, 0, 0] + covariance[i, 1, 1]
        if np.isfinite(variance + planes[i, 0] + planes[i, 1] + planes[i, 2]):
            for k in range(3):
                out[n, k] = planes[i, k]
            out[n, 3] = np.cos(min(0.5 * cone + SIGMAS * np.sqrt(max(variance, 0.0)), cone))
            out[n, 4] = pixels[i] / image
            n += 1
    return out[:n]


@kernel
def followed(
    vectors: F64, weights: F64, first: int, start: F64, shift: tuple[float, float, int, float], planes: F64, rules: ModeLimits
) -> tuple[F64, F64, F64, Bool, bool]:
    """The fields of `Modes`."""
    cone, bandwidth, iterations, tolerance = shift
    axes = shift_axes(vectors, weights, start, cone, bandwidth, iterations, tolerance)
    normals = mode_statistics(vectors[:first], weights[:first], axes, cone)
    lines = mode_statistics(vectors[first:], weights[first:], axes, cone)
    seen, supported = judged(vectors, weights, first, axes, normals, lines, planes, rules)
    for k in range(3):
        if not seen[k]:
            for j in range(3):
                axes[j, k] = start[j, k]
    return axes, normals, lines, seen, supported


@kernel
def judged(vectors: F64, weights: F64, first: int, axes: F64, normals: F64, lines: F64, planes: F64, rules: ModeLimits) -> tuple[Bool, bool]:
    """(3,) which modes are seen, and whether they make a Manhattan frame."""
    peaks = peaks_kernel(vectors, weights, first, axes, normals, lines, planes, rules)
    on_axis = normals[:, 1] + lines[:, 1]
    seen = largest_fitting(peaks, perpendicular(axes, normals, lines, rules.max_skew), on_axis)
    explained = (on_axis * seen).sum() / max(weights.sum(), 1e-9)
    return seen, seen.sum() >= 2 and explained >= rules.min_explained


@kernel
def peaks_kernel(vectors: F64, weights: F64, first: int, axes: F64, normals: F64, lines: F64, planes: F64, rules: ModeLimits) -> Bool:
    """(m,) which of the axes (3, m) are peaks."""
    cone, least, number, share, widest, _, _ = rules
    surfaces = surface_peaks(axes, normals, first, least, widest, planes)
    return surfaces | line_peaks(vectors[first:], weights[first:], axes, lines, number, share, widest, cone)


# Modes of directions on the unit sphere, antipodes being one: mean shift around three axes, search, and weighted fit of a rotation.
#
# Directions are (n, 3) unit rows with (n,) weights. Axes are the columns of a (3, 3) matrix;
# those found by mean shift are unit but only nearly at right angles.

BINS = 90  # one degree each, of a quarter turn
ROWS_APART = 4  # of those in which valid normals are counted


@kernel
def subsample_normals(normals: F32, most: int) -> F64:
    """At most `most` of the finite normals of a grid (h, w, 3), on a regular sub-grid: (n, 3)."""
    h, w = normals.shape[:2]
    valid = 0
    for r in range(0, h, ROWS_APART):
        for c in range(w):
            valid += min(ROWS_APART, h - r) * np.isfinite(normals[r, c, 2])
    step = max(int(np.ceil(np.sqrt(valid / most))), 1)
    out = np.empty((((h + step - 1) // step) * ((w + step - 1) // step), 3))
    n = 0
    for r in range(step // 2, h, step):
        for c in range(step // 2, w, step):
            if np.isfinite(normals[r, c, 0] + normals[r, c, 1] + normals[r, c, 2]) and n < most:
                for k in range(3):
                    out[n, k] = normals[r, c, k]
                n += 1
    return out[:n]


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
def _across(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors at right angles to the unit vector (x, y, z) and to each other."""
    if abs(x) < 0.7:
        norm = np.sqrt(y * y + z * z)
        u = (0.0, z / norm, -y / norm)
    else:
        norm = np.sqrt(x * x + z * z)
        u = (-z / norm, 0.0, x / norm)
    return u[0], u[1], u[2], y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]


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
def density(directions: F64, weights: F64, axes: F64, bandwidth: float) -> float:
    """Sum of the weights, each times a Gaussian of the angle to its nearest axis."""
    total = 0.0
    for i in range(len(directions)):
        dot = 0.0
        for k in range(3):
            dot = max(dot, abs(directions[i, 0] * axes[0, k] + directions[i, 1] * axes[1, k] + directions[i, 2] * axes[2, k]))
        total += weights[i] * np.exp(-0.5 * max(1.0 - dot * dot, 0.0) / (bandwidth * bandwidth))
    return total


@kernel
def orthonormal(axes: F64, weights: F64) -> F64:
    """The rotation nearest to three axes, each counting by its weight: the rotation in `Σ w_k a_k e_kᵀ`. An axis of weight 0
    becomes the cross product of the others; with fewer than two weights the remaining turn is arbitrary."""
    return polar_rotation(axes * weights)


@kernel
def right_handed(first: F64) -> F64:
    """(3, 3) rotation whose first column is the unit vector `first`."""
    across = _across(first[0], first[1], first[2])
    out = np.empty((3, 3))
    for k in range(3):
        out[k, 0], out[k, 1], out[k, 2] = first[k], across[k], across[3 + k]
    return out


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
def search_axes(directions: F64, weights: F64, starts: F64, cone: float, bandwidth: float, primaries: int, turns: int) -> F64:
    """The three orthogonal axes of greatest density, from nothing: each of the `primaries` densest directions with its `turns` fullest turns about it
    is refined and compared. `starts` (m, 3) are directions spread over the half sphere, less than a cone apart. (3, 3) rotation."""
    best, found, alone = -1.0, np.eye(3), np.empty((3, 1))
    chosen = densest(directions, weights, starts, cone, primaries)
    for i in range(len(chosen)):
        for k in range(3):
            alone[k, 0] = chosen[i, k]
        frame = right_handed(shift_axes(directions, weights, alone, cone, bandwidth, 10, 1e-3)[:, 0])
        for turn in _quarter_turns(_histogram(directions, weights, frame, cone), turns):
            c, s = np.cos(turn), np.sin(turn)
            R = frame.copy()
            for k in range(3):
                R[k, 1], R[k, 2] = c * frame[k, 1] + s * frame[k, 2], c * frame[k, 2] - s * frame[k, 1]
            axes = shift_axes(directions, weights, R, cone, bandwidth, 5, 1e-3)
            R = orthonormal(axes, np.sqrt(mode_statistics(directions, weights, axes, cone)[:, 1]) + 1e-9)
            score = density(directions, weights, R, bandwidth)
            if score > best:
                best, found = score, R
    return found


@kernel
def fit_rotation(directions: F64, information: F64, axes: I32, counted: int, R: F64, gate: float, iterations: int) -> tuple[F64, F64, float, float]:
    """Rotation whose columns `axes[i]` best fit measured directions (n, 3), signs free; rows with axis -1 take no part. `information` is (n, 3, 3) in
    1/rad², zero along the direction. Gauss–Newton on `R <- Exp(phi) R` with Cauchy weights, one half at `gate` σ. Returns R, the information of
    phi (3, 3), and of the first `counted` rows the weighted χ² and the weighted number of its components."""
    R = R.copy()
    H, g, r, v, phi = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    chi2, components = 0.0, 0.0
    for remaining in range(iterations, -1, -1):
        for j in range(3):
            g[j] = 0.0
            for k in range(3):
                H[j, k] = 0.0
        chi2, components = 0.0, 0.0
        for i in range(len(directions)):
            if axes[i] < 0:
                continue
            a, L = R[:, axes[i]], information[i]
            sign = 1.0 if directions[i, 0] * a[0] + directions[i, 1] * a[1] + directions[i, 2] * a[2] > 0.0 else -1.0
            for k in range(3):
                r[k] = sign * directions[i, k] - a[k]
            for k in range(3):
                v[k] = L[k, 0] * r[0] + L[k, 1] * r[1] + L[k, 2] * r[2]
            m2 = r[0] * v[0] + r[1] * v[1] + r[2] * v[2]
            w = 1.0 / (1.0 + m2 / (gate * gate))
            # d(phi × a)/d phi = -[a]×, so the gradient is a × (Λ r) and the Hessian [a]× Λ [a]×ᵀ
            _add_cross(a, v, w, g)
            for j in range(3):
                ex = (0.0, -a[2], a[1]) if j == 0 else ((a[2], 0.0, -a[0]) if j == 1 else (-a[1], a[0], 0.0))  # e_j × a
                for k in range(3):
                    v[k] = L[k, 0] * ex[0] + L[k, 1] * ex[1] + L[k, 2] * ex[2]
                _add_cross(a, v, w, H[:, j])
            if i < counted:
                chi2 += w * m2
                components += 2.0 * w
        if remaining == 0:
            break
        for k in range(3):
            H[k, k] += 1e-6  # a turn that nothing measures stays
        solve_positive(H, g, phi)
        left_multiply_exp(phi, R)
    return R, H, chi2, components


@kernel
def _add_cross(a: F64, v: F64, w: float, out: F64) -> None:
    """out += w (a × v)."""
    out[0] += w * (a[1] * v[2] - a[2] * v[1])
    out[1] += w * (a[2] * v[0] - a[0] * v[2])
    out[2] += w * (a[0] * v[1] - a[1] * v[0])


# Whether modes of the sphere are peaks, and at right angles. Statistics (m, 4) are those of `mode_statistics`, angles in rad.

NORMALS_PER_SAMPLE = 20.0  # neighbouring normals share pixels and the sensor's errors: so many count as one


@kernel
def surface_peaks(axes: F64, normals: F64, count: int, least: float, widest: float, planes: F64) -> Bool:
    """(m,) whether the share `least` of `count` normals stands on each axis (3, m), denser than directions without order would (mean square below
    `widest`) or beside planes with that share of the image. A plane is a row of (p, 5): its normal, the cosine of its reach, its share."""
    peaks = np.zeros(len(normals), np.bool_)
    for k in range(len(normals)):
        covered = 0.0
        for n in planes:
            covered += n[4] * (abs(n[0] * axes[0, k] + n[1] * axes[1, k] + n[2] * axes[2, k]) > n[3])
        peaks[k] = (normals[k, 3] < widest or covered >= least) and normals[k, 1] >= least * max(count, 1)
    return peaks


@kernel
def line_peaks(directions: F64, length: F64, axes: F64, lines: F64, number: int, share: float, widest: float, cone: float) -> Bool:
    """(m,) whether `number` lines with `share` of the length of all stand on each axis (3, m), and on the axes together more than lines (n, 3), drawn
    any way on one wall would.

    An axis is measured against the lines that no heavier axis has: a few long ones along a corridor must not outweigh what is across it."""
    peaks, left = np.zeros(len(lines), np.bool_), length.copy()
    any_peak, on_peaks, widest_peak = False, 0.0, 0.0
    for k in descending(lines[:, 1]):
        if lines[k, 0] < number or not lines[k, 3] < widest:
            continue
        least = by_chance(lines[k, 3], cone, 2.0 / (np.pi - 2.0 * cone), left) if any_peak else 0.0
        if lines[k, 1] >= max(share * left.sum(), least):
            peaks[k], any_peak = True, True
            on_peaks += lines[k, 1]
            widest_peak = max(widest_peak, lines[k, 3])
        for i in range(len(left)):
            if abs(directions[i, 0] * axes[0, k] + directions[i, 1] * axes[1, k] + directions[i, 2] * axes[2, k]) > np.cos(cone):
                left[i] = 0.0
    if on_peaks <= by_chance(widest_peak, cone, 4.0 / np.pi, length):  # on one wall two axes gather four times their reach of 180° by chance
        peaks[:] = False
    return peaks


@kernel
def by_chance(mean_square: float, cone: float, per_reach: float, length: F64) -> float:
    """The length that lines (n,) without order have within reach of an axis, give or take 3 sigma; reach is 3 standard deviations of those on it."""
    share = per_reach * min(max(3.0 * np.sqrt(mean_square), np.radians(2.0)), cone)
    return share * length.sum() + 3.0 * np.sqrt(share * (1.0 - share) * (length * length).sum())


@kernel
def perpendicular(axes: F64, normals: F64, lines: F64, skew: float) -> Bool:
    """(m, m) whether two modes (3, m) are within `skew` of a right angle, as far as their own uncertainty can tell."""
    count = len(normals)
    variance, fits = np.empty(count), np.zeros((count, count), np.bool_)
    for k in range(count):
        square = normals[k, 1] * normals[k, 2] + lines[k, 1] * lines[k, 2]
        independent = max(normals[k, 0] / NORMALS_PER_SAMPLE + lines[k, 0], 1.0)
        variance[k] = square / max(normals[k, 1] + lines[k, 1], 1e-9) / (2.0 * independent)
    for i in range(count):
        for j in range(count):
            cosine = axes[0, i] * axes[0, j] + axes[1, i] * axes[1, j] + axes[2, i] * axes[2, j]
            fits[i, j] = np.arcsin(min(abs(cosine), 1.0)) <= skew + 2.0 * np.sqrt(variance[i] + variance[j])
    return fits


@kernel
def largest_fitting(peaks: Bool, fits: Bool, weights: F64) -> Bool:
    """(3,) the most, and of those the heaviest, of three peaks that fit each other."""
    best, rank = np.zeros(3, np.bool_), 0.0
    total = weights.sum() + 1.0
    for chosen in (7, 3, 5, 6, 1, 2, 4):
        good, number, weight = True, 0, 0.0
        for i in range(3):
            if chosen >> i & 1:
                number, weight = number + 1, weight + weights[i]
                good = good and peaks[i]
                for j in range(i):
                    good = good and (fits[i, j] or not chosen >> j & 1)
        if good and number * total + weight > rank:
            rank = number * total + weight
            for i in range(3):
                best[i] = chosen >> i & 1 == 1
    return best
