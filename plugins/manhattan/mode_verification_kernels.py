"""Numba kernels that verify modes of directions: peaks denser than chance, at right angles to each other, enough of them for a Manhattan frame.

Statistics (m, 4) are those of `mode_statistics`; angles are in rad."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.manhattan.directions_kernels import NORMALS_PER_SAMPLE
from trihedron.plugins.shared.sorting_kernels import descending

SIGMAS = 2.0  # by which a plane may deviate


class ModeLimits(NamedTuple):
    """Options of the verification that `modes.mode_limits` converts to rad; `widest` is the largest mean square of a mode."""

    cone: float
    min_share: float
    min_lines: int
    min_line_share: float
    widest: float
    min_explained: float
    max_skew: float


@kernel
def verify_modes_kernel(
    vectors: F64, weights: F64, first: int, axes: F64, normals: F64, lines: F64, planes: F64, limits: ModeLimits
) -> tuple[Bool, bool]:
    """Return the modes that are seen (3,), and True if they make a Manhattan frame."""
    peaks = find_peaks_kernel(vectors, weights, first, axes, normals, lines, planes, limits)
    on_axis, number, explained = np.empty(len(normals)), 0, 0.0
    for k in range(len(normals)):
        on_axis[k] = normals[k, 1] + lines[k, 1]
    seen = largest_fitting(peaks, perpendicular(axes, normals, lines, limits.max_skew), on_axis)
    for k in range(len(seen)):
        if seen[k]:
            number, explained = number + 1, explained + on_axis[k]
    return seen, number >= 2 and explained / max(weights.sum(), 1e-9) >= limits.min_explained


@kernel
def find_peaks_kernel(vectors: F64, weights: F64, first: int, axes: F64, normals: F64, lines: F64, planes: F64, limits: ModeLimits) -> Bool:
    """Return True (m,) for those of the axes (3, m) that are peaks."""
    cone, least, number, share, widest, _, _ = limits
    peaks = surface_peaks(axes, normals, first, least, widest, planes)
    by_lines = line_peaks(vectors[first:], weights[first:], axes, lines, number, share, widest, cone)
    for k in range(len(peaks)):
        peaks[k] = peaks[k] or by_lines[k]
    return peaks


@kernel
def surfaces_of_planes(planes: F64, covariance: F64, pixels: I32, image: float, cone: float) -> F64:
    """Return (p, 5) for `surface_peaks` of the planes (p, 4) that are finite: normal, cosine of the reach, share of the `image` (px).

    A plane reaches half a cone, and as much further as it is uncertain, but no further than a cone."""
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
    for k in descending(lines[:, 1].copy()):
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
    total, squares = 0.0, 0.0
    for i in range(len(length)):
        total, squares = total + length[i], squares + length[i] * length[i]
    return share * total + 3.0 * np.sqrt(share * (1.0 - share) * squares)


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
