"""Numba kernels of `orb.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.shared.sorting_kernels import descending

# Corners of all levels of a pyramid, chosen and directed in one call that holds no lock.


@kernel
def oriented_corners(
    pyramid: Pyramid, threshold: int, threshold_low: int, margin: int, cell_px: int, wanted: int, weights: F64
) -> tuple[I32, I32, F32]:
    """At most `wanted` corners in order of level, row and column, `margin` (at least 16) px from a border: pixels (n, 2) of their levels (n,) and
    directions (n,) in degrees.

    FAST finds them at the high threshold, and at the low one in those cells of the full image that would have less than twice their share; the
    strongest by Harris measure, times their level's weight, are kept, spread over the cells (Rublee et al., ICCV 2011)."""
    pixels, levels, strengths = _candidates(pyramid, threshold_low, margin)
    cells, number = _grid_cells(pixels, levels, pyramid.shapes, cell_px)
    kept = _strong_or_rare(strengths >= threshold, cells, number, wanted)
    pixels, levels, cells = _select(kept, pixels, levels, cells)
    kept = spread_over_cells(cells, number, descending(_harris_scores(pyramid, pixels, levels, weights)), wanted)
    pixels, levels, cells = _select(kept, pixels, levels, cells)
    return pixels, levels, _directions(pyramid, pixels, levels)


@kernel
def _candidates(pyramid: Pyramid, threshold: int, margin: int) -> tuple[I32, I32, I32]:
    """FAST corners of every level: pixels (n, 2), levels (n,) and strengths (n,)."""
    most = len(pyramid.pixels) // 4
    pixels, levels, strengths, n = np.empty((most, 2), np.int32), np.empty(most, np.int32), np.empty(most, np.int32), np.int64(0)
    for level in range(len(pyramid.shapes)):
        first, n = n, find_corners(level_of(pyramid, level), threshold, margin, pixels, strengths, n)
        levels[first:n] = level
    return pixels[:n], levels[:n], strengths[:n]


@kernel
def _grid_cells(pixels: I32, levels: I32, shapes: I32, cell_px: int) -> tuple[I32, int]:
    """Cells (n,) of the full image that corners lie in (see `full_pixels`), and how many cells there are."""
    height, width = shapes[0]
    cell, out = np.empty(max(height, width), np.int32), np.empty(len(pixels), np.int32)
    for x in range(len(cell)):
        cell[x] = x // cell_px
    across = cell[width - 1] + 1
    for i in range(len(pixels)):
        h, w = shapes[levels[i]]
        x = np.float32((pixels[i, 0] + 0.5) * (width / w) - 0.5)
        y = np.float32((pixels[i, 1] + 0.5) * (height / h) - 0.5)
        out[i] = cell[int(y)] * across + cell[int(x)]
    return out, across * (cell[height - 1] + 1)


@kernel
def _strong_or_rare(strong: Bool, cells: I32, number: int, wanted: int) -> Bool:
    """(n,) which corners are strong, or in cells with fewer strong ones than twice a cell's share of those wanted."""
    count, out = np.zeros(number, np.int32), np.empty(len(strong), np.bool_)
    for i in range(len(strong)):
        count[cells[i]] += strong[i]
    for i in range(len(strong)):
        out[i] = strong[i] | (count[cells[i]] < 2.0 * wanted / number)
    return out


@kernel
def _select(kept: Bool, pixels: I32, levels: I32, cells: I32) -> tuple[I32, I32, I32]:
    """Select the corners that are kept: pixels, levels and cells."""
    n = 0
    for i in range(len(kept)):
        n += kept[i]
    kept_pixels, kept_levels, kept_cells, n = np.empty((n, 2), np.int32), np.empty(n, np.int32), np.empty(n, np.int32), 0
    for i in range(len(kept)):
        if kept[i]:
            kept_pixels[n, 0], kept_pixels[n, 1], kept_levels[n], kept_cells[n] = pixels[i, 0], pixels[i, 1], levels[i], cells[i]
            n += 1
    return kept_pixels, kept_levels, kept_cells


@kernel
def _harris_scores(pyramid: Pyramid, pixels: I32, levels: I32, weights: F64) -> F64:
    """(n,) Harris measure times the level's weight."""
    out = np.empty(len(pixels))
    for i in range(len(pixels)):
        place, cols = _place(pyramid, pixels, levels, i)
        out[i] = np.float32(harris_score(pyramid.pixels, place, cols)) * weights[levels[i]]
    return out


@kernel
def _directions(pyramid: Pyramid, pixels: I32, levels: I32) -> F32:
    """(n,) directions of corners, degrees."""
    out = np.empty(len(pixels), np.float32)
    across, inside = half_disc()
    for i in range(len(pixels)):
        place, cols = _place(pyramid, pixels, levels, i)
        out[i] = centroid_angle(pyramid.pixels, place, cols, across, inside)
    return out


@kernel
def _place(pyramid: Pyramid, pixels: I32, levels: I32, i: int) -> tuple[int, int]:
    """Position of a corner in the pyramid's pixels, and their number per row: unsigned, so that no index is taken to count from the end."""
    cols = np.uint64(pyramid.shapes[levels[i], 1])
    return np.uint64(pyramid.starts[levels[i]]) + np.uint64(pixels[i, 1]) * cols + np.uint64(pixels[i, 0]), cols


# Image pyramids and where their pixels lie in the full image.


class Pyramid(NamedTuple):
    """Levels one after another: all pixels (n,), where each level starts in them (levels + 1,), and its height and width (levels, 2)."""

    pixels: U8
    starts: I32
    shapes: I32

    def images(self) -> list[U8]:
        """Each level (h, w), as a view of the pixels."""
        return [self.pixels[start : start + h * w].reshape(h, w) for (h, w), start in zip(self.shapes.tolist(), self.starts.tolist())]


@kernel
def level_of(pyramid: Pyramid, level: int) -> U8:
    """(h, w) one level."""
    h, w = pyramid.shapes[level]
    return pyramid.pixels[pyramid.starts[level] : pyramid.starts[level + 1]].reshape((h, w))


@kernel
def full_pixels(cells: I32, levels: I32, shapes: I32) -> F64:
    """(n, 2) positions in the full image of pixels (n, 2) of their levels (n,), pixel centres at integers: x is centred at (x + ½) s − ½."""
    out = np.empty((len(cells), 2))
    for i in range(len(cells)):
        h, w = shapes[levels[i]]
        out[i, 0] = (cells[i, 0] + 0.5) * (shapes[0, 1] / w) - 0.5
        out[i, 1] = (cells[i, 1] + 0.5) * (shapes[0, 0] / h) - 0.5
    return out


# FAST corners with their strength, in one call that holds no lock.

RADIUS = 3  # px of the circle compared with


@kernel
def fast_corners(image: U8, threshold: int, margin: int) -> tuple[I32, I32]:
    """FAST-9 corners (Rosten & Drummond, ECCV 2006) of an image (h, w), in rows: pixels (n, 2) and strengths (n,).

    A pixel's strength is the largest threshold at which it is a corner; only those of at least `threshold`, stronger than their eight neighbours
    and not nearer than `margin` (at least 4) px to the border are given. So the corners at a higher threshold are those of that strength."""
    pixels, strengths = np.empty((image.size // 4, 2), np.int32), np.empty(image.size // 4, np.int32)
    n = find_corners(image, threshold, margin, pixels, strengths, 0)
    return pixels[:n].copy(), strengths[:n].copy()


@kernel
def find_corners(image: U8, threshold: int, margin: int, pixels: I32, strengths: I32, n: int) -> int:
    """Writes the corners of `fast_corners` to `pixels` and `strengths` from row n on; returns the row after the last. A quarter of the image's pixels
    cannot be more of them."""
    rows, cols = image.shape
    first = max(margin, RADIUS + 1) - 1  # neighbours are compared with beyond the margin
    width = cols - 2 * first
    if width < 3 or rows - 2 * first < 3:
        return n
    strength = np.zeros((3, width), np.uint8)  # of the last three rows
    peaks = np.zeros(-(-width // 8) * 8, np.uint8)  # of a row, looked through eight at a time
    eights = peaks.view(np.uint64)
    for y in range(first, rows - first):
        _strengths(image, y, first, strength[y % 3])
        if y < first + 2:
            continue
        _peaks(strength[(y - 2) % 3], strength[(y - 1) % 3], strength[y % 3], threshold, peaks[:width])
        for e in range(len(eights)):
            if eights[e] != 0:
                for i in range(8 * e, 8 * e + 8):
                    if peaks[i] != 0:
                        pixels[n, 0], pixels[n, 1], strengths[n] = first + i, y - 1, peaks[i]
                        n += 1
    return n


@kernel
def _strengths(image: U8, y: int, first: int, out: U8) -> None:
    """Writes the strength of a row's pixels from column `first`: (width,). Straight bytes, so that the compiler takes 32 pixels at a time."""
    left, right = first - RADIUS, first + len(out) + RADIUS
    d3, d2, d1 = image[y + 3, left:right], image[y + 2, left:right], image[y + 1, left:right]
    m0 = image[y, left:right]
    u1, u2, u3 = image[y - 1, left:right], image[y - 2, left:right], image[y - 3, left:right]
    for i in range(len(out)):
        c = m0[i + 3]
        p0, p1, p2, p3, p4, p5, p6, p7 = d3[i + 3], d3[i + 4], d2[i + 5], d1[i + 6], m0[i + 6], u1[i + 6], u2[i + 5], u3[i + 4]
        p8, p9, p10, p11, p12, p13, p14, p15 = u3[i + 3], u3[i + 2], u2[i + 1], u1[i], m0[i], d1[i], d2[i + 1], d3[i + 2]
        bright = _arc(p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11, p12, p13, p14, p15)
        dark = _arc(
            np.uint8(~p0), np.uint8(~p1), np.uint8(~p2), np.uint8(~p3), np.uint8(~p4), np.uint8(~p5), np.uint8(~p6), np.uint8(~p7),
            np.uint8(~p8), np.uint8(~p9), np.uint8(~p10), np.uint8(~p11), np.uint8(~p12), np.uint8(~p13), np.uint8(~p14), np.uint8(~p15),
        )  # fmt: skip
        d = int(~c) & 255
        above, below = np.uint8(max(bright, c) - c), np.uint8(max(dark, d) - d)
        more = max(above, below)
        out[i] = np.uint8(max(more, np.uint8(1)) - 1)


@kernel
def _arc(
    p0: int, p1: int, p2: int, p3: int, p4: int, p5: int, p6: int, p7: int,
    p8: int, p9: int, p10: int, p11: int, p12: int, p13: int, p14: int, p15: int,
) -> int:  # fmt: skip
    """The largest grey level that 9 neighbours in a row on the circle all reach."""
    m1, m3, m5, m7, m9, m11, m13, m15 = (
        min(p1, p2), min(p3, p4), min(p5, p6), min(p7, p8), min(p9, p10), min(p11, p12), min(p13, p14), min(p15, p0),
    )  # fmt: skip
    q1, q3, q5, q7, q9, q11, q13, q15 = (
        min(m1, m3), min(m3, m5), min(m5, m7), min(m7, m9), min(m9, m11), min(m11, m13), min(m13, m15), min(m15, m1),
    )  # fmt: skip
    r0 = min(min(q1, q5), max(p0, p9))  # 1 to 8, and 0 or 9
    r2 = min(min(q3, q7), max(p2, p11))
    r4 = min(min(q5, q9), max(p4, p13))
    r6 = min(min(q7, q11), max(p6, p15))
    r8 = min(min(q9, q13), max(p8, p1))
    r10 = min(min(q11, q15), max(p10, p3))
    r12 = min(min(q13, q1), max(p12, p5))
    r14 = min(min(q15, q3), max(p14, p7))
    return max(max(max(r0, r2), max(r4, r6)), max(max(r8, r10), max(r12, r14)))


@kernel
def _peaks(above: U8, here: U8, below: U8, threshold: int, out: U8) -> None:
    """Writes into `out` (width,) the strengths of a row that reach the threshold and exceed their eight neighbours', else 0."""
    least = np.uint8(threshold)
    n = len(out) - 2
    inner = out[1:-1]
    b0, b1, b2 = above[:n], above[1 : n + 1], above[2:]
    h0, h1, h2 = here[:n], here[1 : n + 1], here[2:]
    u0, u1, u2 = below[:n], below[1 : n + 1], below[2:]
    for i in range(n):
        others = max(max(max(b0[i], b1[i]), max(b2[i], h0[i])), max(max(h2[i], u0[i]), max(u1[i], u2[i])))
        s = h1[i]
        inner[i] = s if (s > others) & (s >= least) else np.uint8(0)


# Strength and orientation of corners, from the pixels of an image one row after another.

HARRIS_K = 0.04  # Harris & Stephens (1988), the usual value
BLOCK = 3  # half side of the window of gradients
PATCH = 15  # radius of the disc the orientation is taken from (Rublee et al., ICCV 2011)
ROW = 32  # px looked at in a row of the disc: a constant that the compiler can take several of at once; the last counts nothing


@kernel
def harris_score(pixels: U8, corner: int, cols: int) -> float:
    """Harris measure `det - k trace²` of the gradients (Sobel) in the 7 × 7 window around a pixel, given by its unsigned place in rows of `cols`, and
    at least 5 px from the border."""
    a, b, c = np.int32(0), np.int32(0), np.int32(0)
    first = corner - np.uint64(BLOCK + 1) * cols - np.uint64(BLOCK + 1)
    for q in range(np.uint64(2 * BLOCK + 2)):  # columns side by side; the last counts nothing
        aa, ab, bb = np.int32(0), np.int32(0), np.int32(0)
        for r in range(np.uint64(2 * BLOCK + 1)):
            u = first + r * cols + q
            m, d = u + cols, u + cols + cols
            nw, n, ne = np.int32(pixels[u]), np.int32(pixels[u + np.uint64(1)]), np.int32(pixels[u + np.uint64(2)])
            w, e = np.int32(pixels[m]), np.int32(pixels[m + np.uint64(2)])
            sw, s, se = np.int32(pixels[d]), np.int32(pixels[d + np.uint64(1)]), np.int32(pixels[d + np.uint64(2)])
            gx, gy = np.int32(ne - nw + 2 * (e - w) + se - sw), np.int32(sw - nw + 2 * (s - n) + se - ne)
            aa, ab, bb = np.int32(aa + gx * gx), np.int32(ab + gx * gy), np.int32(bb + gy * gy)
        inside = np.int32(q < 2 * BLOCK + 1)
        a, b, c = np.int32(a + aa * inside), np.int32(b + ab * inside), np.int32(c + bb * inside)
    scale = 1.0 / (4.0 * 49.0 * 255.0)
    p, q2, t = a * scale, c * scale, b * scale
    return p * q2 - t * t - HARRIS_K * (p + q2) * (p + q2)


@kernel
def half_disc() -> tuple[F32, F32]:
    """For `centroid_angle`: of the pixels in rows 0 … `PATCH` of the disc, each `ROW` from column -`PATCH`, how far they are to the right, and 1;
    0 for those outside. Row 0 counts half, for it is taken twice."""
    across, inside = np.zeros((PATCH + 1) * ROW, np.float32), np.zeros((PATCH + 1) * ROW, np.float32)
    for v in range(PATCH + 1):
        half = int(np.rint(np.sqrt(PATCH * PATCH - v * v)))
        for u in range(-half, half + 1):
            inside[v * ROW + PATCH + u] = 1.0 if v > 0 else 0.5
            across[v * ROW + PATCH + u] = u * inside[v * ROW + PATCH + u]
    return across, inside


@kernel(fastmath={"reassoc"})  # the sums are of small integers: exact in any order
def centroid_angle(pixels: U8, corner: int, cols: int, across: F32, inside: F32) -> float:
    """Direction from a pixel to the intensity centroid of the disc around it, degrees in [0, 360), x right and y down.

    The pixel is given by its unsigned place in rows of `cols`, and at least `PATCH` + 1 px from the border; `across` and `inside` as from
    `half_disc`."""
    mx, my = 0.0, 0.0
    above = corner - np.uint64(PATCH)
    below = above
    for v in range(np.uint64(PATCH + 1)):
        moment, more = np.float32(0.0), np.float32(0.0)
        for k in range(np.uint64(ROW)):
            up, down, i = np.float32(pixels[above + k]), np.float32(pixels[below + k]), v * np.uint64(ROW) + k
            moment += (up + down) * across[i]
            more += (down - up) * inside[i]
        mx += moment
        my += float(v) * more
        above, below = above - cols, below + cols
    angle = np.degrees(np.arctan2(my, mx))
    return angle + 360.0 if angle < 0.0 else angle


# Choosing image features spread over the image.


@kernel
def spread_over_cells(cells: I32, number: int, order: I32, wanted: int) -> Bool:
    """Select features (n,) spread over the image: each of a `number` of cells gives its best in turn until `wanted` are selected.

    `cells` (n,) is the cell of each feature; `order` lists the rows from best to worst. The quota per cell is the largest that keeps the total
    within `wanted`, and the best of the rest fill up, so a rich corner cannot take everything and an even image keeps its best."""
    n = len(cells)
    if n <= wanted:
        return np.ones(n, np.bool_)
    keep, rank, count = np.zeros(n, np.bool_), np.zeros(n, np.int32), np.zeros(number, np.int32)  # rank: place within the cell
    for i in order:
        rank[i] = count[cells[i]]
        count[cells[i]] += 1
    quota, total = 0, 0
    while True:
        more = 0
        for k in count:
            more += k > quota
        if total + more > wanted:
            break
        total += more
        quota += 1
    left = wanted - total
    for i in order:
        if rank[i] < quota:
            keep[i] = True
        elif rank[i] == quota and left > 0:
            keep[i] = True
            left -= 1
    return keep


# Binary descriptors of oriented key points: steered BRIEF.

BITS = 256
REACH_PX = 15  # of a test's ends from the key point: patches of 31 px (Rublee et al.)
WINDOW_PX = 7  # side of the square each end of a test is the mean of
AREA = WINDOW_PX * WINDOW_PX


@kernel
def steered_brief(pyramid: Pyramid, cells: I32, levels: I32, angles_deg: F32, tests: F32) -> U8:
    """(n, 32) descriptors of the pixels (n, 2) of their levels (n,), none nearer to a border than `REACH_PX` and half a window.

    Bit i is whether the mean about the first end of test i is darker than that about the second, the tests turned by the key point's angle
    (Calonder et al., ECCV 2010; Rublee et al., ICCV 2011)."""
    smooth = np.empty_like(pyramid.pixels)
    for level in range(len(pyramid.shapes)):
        h, w = pyramid.shapes[level]
        _window_means(pyramid.pixels, np.uint64(pyramid.starts[level]), np.uint64(h), np.uint64(w), smooth)
    out = np.zeros((len(cells), BITS // 8), np.uint8)
    first, second = np.empty(BITS, np.int32), np.empty(BITS, np.int32)
    for i in range(len(cells)):
        angle = np.radians(angles_deg[i])
        c, s, width = np.cos(angle), np.sin(angle), pyramid.shapes[levels[i], 1]
        _places(tests[0], tests[1], c, s, width, first)
        _places(tests[2], tests[3], c, s, width, second)
        around = smooth[pyramid.starts[levels[i]] + (cells[i, 1] - REACH_PX - 1) * width :]
        centre = (REACH_PX + 1) * width + cells[i, 0]
        for byte in range(BITS // 8):
            bits = 0
            for k in range(8):
                bits |= (around[centre + first[8 * byte + k]] < around[centre + second[8 * byte + k]]) << k
            out[i, byte] = bits
    return out


@kernel
def _window_means(pixels: U8, start: int, h: int, w: int, out: U8) -> None:
    """Writes the rounded mean of the window about each pixel of a level, but for those less than half a window from its border. Two bytes hold what
    is summed, and unsigned indices do not count from the end, so that the compiler takes 32 pixels at a time."""
    side, half = np.uint64(WINDOW_PX), np.uint64(WINDOW_PX // 2)
    if h < side or w < side:
        return
    columns = np.zeros(w, np.uint16)  # sums over the window's rows
    for r in range(side):
        for c in range(w):
            columns[c] += pixels[start + r * w + c]
    for r in range(half, h - half):
        here = start + r * w
        for c in range(w - side + np.uint64(1)):
            total = np.uint16(AREA // 2)
            for k in range(side):
                total = np.uint16(total + columns[c + k])
            out[here + half + c] = total // np.uint16(AREA)
        if r + half + np.uint64(1) < h:
            old, new = here - half * w, here + (half + np.uint64(1)) * w
            for c in range(w):
                columns[c] = np.uint16(np.uint16(columns[c] + pixels[new + c]) - pixels[old + c])


@kernel
def _places(x: F32, y: F32, c: float, s: float, width: int, out: I32) -> None:
    """Writes how many pixels after the centre the turned ends (n,) lie, in rows of `width`."""
    for k in range(len(out)):
        row = np.int32(np.rint(x[k] * s + y[k] * c))
        out[k] = row * width + np.int32(np.rint(x[k] * c - y[k] * s))
