"""Numba kernels of `atlanta.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.manhattan.directions_kernels import NORMALS_PER_SAMPLE
from trihedron.plugins.manhattan.mean_shift_kernels import right_handed
from trihedron.plugins.shared.lie_kernels import left_multiply_exp

# Directions about a vertical, modulo a quarter turn: where they crowd more than by chance, and which crowd is which from image to image.

BINS = 90  # one degree each, of a quarter turn
WINDOW = 4  # bins on each side of an azimuth that belong to it
CONTRAST, SIGMA = 2.5, 3.0  # a mode has so many times what directions without order would, and so many of their standard deviations more
QUARTER = 0.5 * np.pi


@kernel
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
        masses[found], rotations[found] = inside, _rotate_about_vertical(base, angle)
        found += 1
        if found == most:
            break
        for k in range(-apart, apart + 1):
            histogram[(peak + k) % BINS], squares[(peak + k) % BINS] = 0.0, 0.0
    return rotations[:found], masses[:found]


@kernel
def _rotate_about_vertical(base: F64, angle: float) -> F64:
    """`base` (3, 3) turned about its third column."""
    out, c, s = base.copy(), np.cos(angle), np.sin(angle)
    for k in range(3):
        out[k, 0], out[k, 1] = c * base[k, 0] + s * base[k, 1], c * base[k, 1] - s * base[k, 0]
    return out


@kernel
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


@kernel
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


# Rotations that share their third axis, fitted together to directions on any of their axes.


@kernel
def fit_shared_vertical(
    directions: F64, information: F64, columns: I32, counted: int, rotations: F64, prior: float, gate: float, iterations: int
) -> tuple[F64, F64, float, float]:
    """Rotations (k, 3, 3) with one and the same third axis that best fit measured directions (n, 3), signs free.

    `columns` (n,) is 3 frame + axis, -1 takes no part; `information` (n, 3, 3) in 1/rad², zero along the direction. Gauss–Newton with Cauchy weights,
    one half at `gate` σ, over the tilt of the vertical about the first frame's two other axes and a turn of each frame about the vertical; `prior`
    (1/rad²) holds what is not observed. Returns the rotations, the information (2 + k, 2 + k) of these numbers, and of the first `counted` rows
    the weighted χ² and the weighted number of its components."""
    frames = len(rotations)
    rotations, size = rotations.copy(), 2 + frames
    H, g, x = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    J, LJ, r, phi = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    chi2, components = 0.0, 0.0
    for remaining in range(iterations, -1, -1):
        H[:] = 0.0
        g[:] = 0.0
        chi2, components = 0.0, 0.0
        for i in range(len(directions)):
            if columns[i] < 0:
                continue
            frame, axis = columns[i] // 3, columns[i] % 3
            a, L = rotations[frame, :, axis], information[i]
            sign = 1.0 if directions[i, 0] * a[0] + directions[i, 1] * a[1] + directions[i, 2] * a[2] > 0.0 else -1.0
            for k in range(3):
                r[k] = sign * directions[i, k] - a[k]
            for j in range(3):  # d(phi × a) for the three turns
                about = rotations[0, :, j] if j < 2 else rotations[frame, :, 2]
                for k in range(3):
                    p, q = (k + 1) % 3, (k + 2) % 3
                    J[k, j] = about[p] * a[q] - about[q] * a[p]
            m2 = 0.0
            for k in range(3):
                for m in range(3):
                    m2 += r[k] * L[k, m] * r[m]
                    LJ[k, m] = L[k, 0] * J[0, m] + L[k, 1] * J[1, m] + L[k, 2] * J[2, m]
            w = 1.0 / (1.0 + m2 / (gate * gate))
            for j in range(3):
                row = j if j < 2 else 2 + frame
                for m in range(3):
                    column = m if m < 2 else 2 + frame
                    H[row, column] += w * (J[0, j] * LJ[0, m] + J[1, j] * LJ[1, m] + J[2, j] * LJ[2, m])
                g[row] += w * (LJ[0, j] * r[0] + LJ[1, j] * r[1] + LJ[2, j] * r[2])
            if i < counted:
                chi2 += w * m2
                components += 2.0 * w
        if remaining == 0:
            break
        for k in range(size):
            H[k, k] += prior
        solve_positive(H, g, x)
        first = rotations[0].copy()
        for f in range(frames):
            for k in range(3):
                phi[k] = x[0] * first[k, 0] + x[1] * first[k, 1] + x[2 + f] * first[k, 2]
            left_multiply_exp(phi, rotations[f])
            if f > 0:  # turns about the vertical and tilts commute to first order only
                rotations[f] = shared_vertical(rotations[0], rotations[f])
    return rotations, H, chi2, components


@kernel
def shared_vertical(first: F64, R: F64) -> F64:
    """R (3, 3) with the third column of `first` (3, 3), its first column staying as near as it can."""
    out = np.empty((3, 3))
    dot, norm = 0.0, 0.0
    for k in range(3):
        dot += R[k, 0] * first[k, 2]
    for k in range(3):
        out[k, 2] = first[k, 2]
        out[k, 0] = R[k, 0] - dot * first[k, 2]
        norm += out[k, 0] ** 2
    for k in range(3):
        out[k, 0] /= np.sqrt(norm)
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        out[k, 1] = out[p, 2] * out[q, 0] - out[q, 2] * out[p, 0]
    return out
