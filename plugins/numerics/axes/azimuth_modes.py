"""Directions about a vertical, modulo a quarter turn: where they crowd more than by chance, and which crowd is which from image to image."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.geometry import exp_so3
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.axes.mode_tests import NORMALS_PER_SAMPLE
from trihedron.plugins.numerics.axes.sphere_modes import right_handed

BINS = 90  # one degree each, of a quarter turn
WINDOW = 4  # bins on each side of an azimuth that belong to it
CONTRAST, SIGMA = 2.5, 3.0  # a mode has so many times what directions without order would, and so many of their standard deviations more
QUARTER = 0.5 * np.pi


@numba.njit(cache=True, nogil=True, error_model="numpy")
def azimuth_modes(vectors: F64, weights: F64, first_line: int, vertical: F64, cone: float, apart: int, most: int, least: float) -> tuple[F64, F64]:
    """Rotations (k, 3, 3) with the vertical as third column and a horizontal mode as first, heaviest first, and their weights (k,).

    Of the directions within `cone` (rad) of the horizontal; at most `most` modes, `apart` bins from each other, each of a weight of at least `least`
    and standing out from a uniform distribution of all that the heavier ones leave."""
    frame = right_handed(vertical)
    base = np.stack((frame[:, 1], frame[:, 2], frame[:, 0]), axis=1)
    histogram, squares = _histograms(vectors, weights, first_line, base, np.sin(cone), NORMALS_PER_SAMPLE)
    share, rotations, masses, found = (2.0 * WINDOW + 1.0) / BINS, np.empty((most, 3, 3)), np.empty(most), 0
    for peak in _peaks(histogram, apart):
        inside, moment = 0.0, 0.0
        for k in range(-WINDOW, WINDOW + 1):
            inside += histogram[(peak + k) % BINS]
            moment += k * histogram[(peak + k) % BINS]
        expected = share * histogram.sum()
        chance = expected + SIGMA * np.sqrt(share * (1.0 - share) * squares.sum())
        if inside <= 0.0 or inside < max(least, CONTRAST * expected, chance):
            continue
        angle = (peak + 0.5 + moment / inside) * QUARTER / BINS
        masses[found], rotations[found] = inside, _turned(base, angle)
        found += 1
        if found == most:
            break
        for k in range(-apart, apart + 1):
            histogram[(peak + k) % BINS], squares[(peak + k) % BINS] = 0.0, 0.0
    return rotations[:found], masses[:found]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turned(base: F64, angle: float) -> F64:
    """`base` (3, 3) turned about its third column."""
    out, c, s = base.copy(), np.cos(angle), np.sin(angle)
    for k in range(3):
        out[k, 0], out[k, 1] = c * base[k, 0] + s * base[k, 1], c * base[k, 1] - s * base[k, 0]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _histograms(vectors: F64, weights: F64, first_line: int, base: F64, limit: float, alike: float) -> tuple[F64, F64]:
    """(BINS,) weight of the directions near the plane of the first two columns of `base`, by their turn, and the squares of what errs independently;
    `alike` normals of weight 1 err alike."""
    histogram, squares = np.zeros(BINS), np.zeros(BINS)
    for i in range(len(vectors)):
        x, y, z, w = vectors[i, 0], vectors[i, 1], vectors[i, 2], weights[i]
        if abs(x * base[0, 2] + y * base[1, 2] + z * base[2, 2]) < limit:
            angle = np.arctan2(x * base[0, 1] + y * base[1, 1] + z * base[2, 1], x * base[0, 0] + y * base[1, 0] + z * base[2, 0])
            k = int(np.floor(angle * BINS / QUARTER)) % BINS
            histogram[k] += w
            squares[k] += w * (alike if i < first_line else w)
    return histogram, squares


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _peaks(histogram: F64, apart: int) -> I32:
    """Bins where the smoothed histogram is largest within `apart`, fullest first."""
    smooth, tops, found = np.zeros(BINS), np.empty(BINS, np.int32), 0
    for i in range(BINS):
        for k in range(-WINDOW, WINDOW + 1):
            smooth[i] += (WINDOW + 1.0 - abs(k)) * histogram[(i - k) % BINS]
    for i in range(BINS):
        top = smooth[i] > 0.0
        for k in range(-apart, apart + 1):
            top = top and smooth[i] >= smooth[(i + k) % BINS]
        if top:
            tops[found] = i
            found += 1
    return tops[:found][np.argsort(-smooth[tops[:found]], kind="mergesort")]


def named_azimuths(found: F64, known: F64, limit: float, furthest: float) -> tuple[F64, I32]:
    """The rotations found (f, 3, 3) with their columns named like those of the known ones (k, 3, 3) that they are, and the rows (f,) of these, -1 for
    none; each set shares its third columns.

    The known ones keep their angles to each other: they are turned so that most of them are found within `limit` (rad), by no more than `furthest`
    when that finds any, and by the least of such turns."""
    flip = np.diag([1.0, -1.0, -1.0]) if found[0, :, 2] @ known[0, :, 2] < 0.0 else np.eye(3)
    found = found @ flip
    azimuth = _azimuths(found, found[0])
    expected = _azimuths(_tilted(known, found[0, :, 2]), found[0])
    apart = _wrapped(azimuth[:, None] - expected[None])
    turns = apart.ravel()
    matched = np.abs(_wrapped(apart[None] - turns[:, None, None])) <= limit
    number = np.minimum(matched.any(axis=1).sum(axis=1), matched.any(axis=2).sum(axis=1))
    near = np.abs(turns) <= furthest
    turn = turns[np.lexsort((np.abs(turns), -number, ~near))[0]]
    off = np.abs(_wrapped(apart - turn))
    rows = np.full(len(found), -1, np.int32)
    while off.min() <= limit:
        f, k = np.unravel_index(int(np.argmin(off)), off.shape)
        rows[f] = k
        off[f], off[:, k] = np.inf, np.inf
    steps = np.round((expected[np.maximum(rows, 0)] + turn - azimuth) / QUARTER) * QUARTER
    return np.array([exp_so3(step * R[:, 2]) @ R for step, R in zip(steps, found)]), rows


def _azimuths(rotations: F64, base: F64) -> F64:
    """(k,) turn of the first column of each about the third of `base` (rad)."""
    return np.arctan2(rotations[:, :, 0] @ base[:, 1], rotations[:, :, 0] @ base[:, 0])


def _wrapped(angles: F64) -> F64:
    """To -45° … 45°."""
    return np.asarray(angles - np.round(angles / QUARTER) * QUARTER)


def _tilted(rotations: F64, vertical: F64) -> F64:
    """(k, 3, 3) with their common third column turned onto `vertical` the shortest way."""
    axis = np.cross(rotations[0, :, 2], vertical)
    sine, cosine = float(np.linalg.norm(axis)), float(rotations[0, :, 2] @ vertical)
    return rotations if sine < 1e-12 else exp_so3(axis / sine * np.arctan2(sine, cosine)) @ rotations
