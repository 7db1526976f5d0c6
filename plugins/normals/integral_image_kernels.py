"""Kernels of `integral_image.py`: normals from tangent vectors averaged over image patches by integral images (Holzer et al., IROS 2012)."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8

SUMS = np.dtype([("n", "f8"), ("z", "f8"), ("uz", "f8"), ("vz", "f8")])  # over pixels with depth: their count, Σz, Σuz and Σvz
VECTOR = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")])
Records = NDArray[np.void]  # of SUMS or VECTOR: their size is known when a kernel is compiled, so that it takes several at once


@kernel
def patch_normals(
    depth: F32, stride: int, edge: tuple[int, float, float], radii: I32, share: float, intrinsics: tuple[float, float, float, float]
) -> F32:
    """(h, w, 3) unit normals towards the camera of blocks of stride × stride pixels; NaN where a block has no depth or no patch free of depth edges.

    `edge` is as in `_smooth_blocks`; `radii[i]` is the patch's half-width in blocks at a depth of i decimetres (the last entry serves beyond);
    `share` of the pixels of half a patch must have depth. Any difference of mean points of a plane lies in the plane, so missing pixels do not bias
    the normal. The mean of a patch's right half less that of its left half is the mean of its horizontal tangents, likewise for the vertical ones.
    Neighbouring blocks with patches of one size are taken at once. Of the integral images only the rows that patches reach are kept, one after
    another in the same place: they stay in the processor's caches, where whole ones take twice the time."""
    rows, cols = depth.shape
    h, w, most = (rows + stride - 1) // stride, (cols + stride - 1) // stride, radii.max()
    out, rings = np.empty((h, w), VECTOR), _clear_rings(_smooth_blocks(depth, stride, edge), most)
    size, last, least, kept = np.empty(w, np.int32), len(radii) - 1, share * stride**2, 2 * most + 2
    sums, strip, block = np.empty((kept, w + 1), SUMS), np.zeros((stride, w * stride), np.float32), np.empty((4, w))
    halves, needed = np.empty((4, w), SUMS), np.empty((2, w))  # sums over each patch's east, west, south and north half, and the points these need
    flat, flat_halves = sums.reshape(-1).view(np.float64), halves.reshape(-1).view(np.float64)
    sums[0].view(np.float64)[:] = 0.0
    flat_halves[:] = 0.0
    done = np.int64(0)  # as a literal, numba would compile `_block_row` for it, too
    for r in range(h):
        while done < min(r + most + 1, h):
            _read_strip(depth, done * stride, strip)
            if stride == 2:  # a constant lets the compiler take several blocks at once
                _block_row(strip, 2, done, block)
            else:
                _block_row(strip, stride, done, block)
            _integrate(block, sums[done % kept], sums[(done + 1) % kept])
            done += 1
        _decimetres(sums[r % kept], sums[(r + 1) % kept], size)
        for c in range(w):
            size[c] = min(radii[min(size[c], last)], rings[r, c]) if size[c] >= 0 else 0
        needed[:] = np.inf
        c = np.int64(0)
        while c < w:
            k, first = size[c], c
            c += 1
            if k == 0:
                continue
            if first >= k:
                while c < w - k and size[c] == k:
                    c += 1
            _halves(flat, kept, h, w, r, first, c, k, least, flat_halves, needed)
        _normals_of_row(halves[0], halves[1], halves[2], halves[3], needed, intrinsics, out[r])
    return out.reshape(-1).view(np.float32).reshape(h, w, 3)


@kernel
def _smooth_blocks(depth: F32, stride: int, edge: tuple[int, float, float]) -> U8:
    """(h, w) 0 where a block of stride × stride pixels holds a depth edge, else 1.

    An edge (reach, jump, jump_m) is two pixels in a row or column, `reach` px apart at most and nothing measured between, that differ by more than
    `jump·z + jump_m`."""
    rows, cols = depth.shape
    reach, jump, jump_m = edge
    smooth = np.ones(((rows + stride - 1) // stride, (cols + stride - 1) // stride), np.uint8)
    z, marks = np.empty(cols, np.float32), np.empty(cols, np.uint8)
    above, above_row = np.zeros(cols, np.float32), np.full(cols, -reach - 1, np.int32)
    for y in range(rows):
        _copy_valid(depth[y], z)
        if _mark_edges(z, above, above_row, y, reach, jump, jump_m, marks):
            _clear_edge_blocks(z, above_row, y, reach, jump, jump_m, marks, stride, smooth)
        _update_above(z, above, above_row, y)
    return smooth


@kernel
def _copy_valid(depth: F32, z: F32) -> None:
    """Copy a row of depths, 0 = none."""
    for x in range(len(depth)):
        z[x] = depth[x] if depth[x] > 0.0 and depth[x] < np.inf else np.float32(0.0)


@kernel
def _read_strip(depth: F32, first: int, strip: F32) -> None:
    """Copy the depths of a row of blocks to `strip` (stride, w · stride), 0 = none."""
    rows, cols = depth.shape
    for i in range(len(strip)):
        if first + i < rows:
            _copy_valid(depth[first + i], strip[i, :cols])
        else:
            strip[i] = 0.0


@kernel
def _is_edge(z: float, other: float, jump: float, jump_m: float) -> bool:
    return abs(z - other) > jump * min(z, other) + jump_m


@kernel
def _mark_edges(z: F32, above: F32, above_row: I32, y: int, reach: int, jump: float, jump_m: float, marks: U8) -> bool:
    """Mark the depth edges in a row of depths, 0 = none: 1 = a step from the depth above, 2 = from the pixel on the left, 4 = no depth on the left.
    Returns True if there are any."""
    for x in range(len(z)):
        marks[x] = (z[x] > 0.0) & (y - above_row[x] <= reach) & _is_edge(z[x], above[x], jump, jump_m)
    here, left, after = z[1:], z[:-1], marks[1:]
    some = marks[0]
    for x in range(len(here)):
        across = np.uint8(2) * _is_edge(here[x], left[x], jump, jump_m) if left[x] > 0.0 else np.uint8(4)
        after[x] |= across if here[x] > 0.0 else np.uint8(0)
    for x in range(len(z)):
        some |= marks[x]
    return some > 0


@kernel
def _clear_edge_blocks(z: F32, above_row: I32, y: int, reach: int, jump: float, jump_m: float, marks: U8, stride: int, smooth: U8) -> None:
    """Write 0 to the blocks on both sides of a row's edges."""
    r = y // stride
    for x in range(len(z)):
        if marks[x] == 0:
            continue
        if marks[x] & 1:
            smooth[r, x // stride] = smooth[above_row[x] // stride, x // stride] = 0
        left = x - 1
        if marks[x] & 4:
            while left >= 0 and x - left <= reach and z[left] == 0.0:
                left -= 1
            if left < 0 or x - left > reach or not _is_edge(z[x], z[left], jump, jump_m):
                continue
        if marks[x] & 6:
            smooth[r, x // stride] = smooth[r, left // stride] = 0


@kernel
def _update_above(z: F32, above: F32, above_row: I32, y: int) -> None:
    """Update the last depth measured in each column, and its row."""
    for x in range(len(z)):
        above[x] = z[x] if z[x] > 0.0 else above[x]
        above_row[x] = y if z[x] > 0.0 else above_row[x]


@kernel
def _block_row(strip: F32, stride: int, r: int, out: F64) -> None:
    """Count, Σz, Σuz and Σvz (4, w) of the blocks of a strip (stride, w · stride)."""
    counts, totals, alongs, downs = out[0], out[1], out[2], out[3]
    for c in range(len(counts)):
        n, total, along, down = 0.0, 0.0, 0.0, 0.0
        for i in range(stride):
            for j in range(stride):
                z = float(strip[i, c * stride + j])
                n += z > 0.0
                total += z
                along += (c * stride + j) * z
                down += (r * stride + i) * z
        counts[c], totals[c], alongs[c], downs[c] = n, total, along, down


@kernel
def _integrate(block: F64, above: Records, out: Records) -> None:
    """Compute the next row (w + 1,) of the integral images."""
    n, total, along, down = 0.0, 0.0, 0.0, 0.0
    out[0]["n"], out[0]["z"], out[0]["uz"], out[0]["vz"] = n, total, along, down
    for c in range(block.shape[1]):
        n, total, along, down = n + block[0, c], total + block[1, c], along + block[2, c], down + block[3, c]
        i = c + 1
        out[i]["n"], out[i]["z"], out[i]["uz"], out[i]["vz"] = above[i]["n"] + n, above[i]["z"] + total, above[i]["uz"] + along, above[i]["vz"] + down


@kernel
def _clear_rings(smooth: U8, most: int) -> U8:
    """Count (h, w) the rings of blocks about each block, `most` at most, that are free of depth edges; outside the image is free."""
    h, w = smooth.shape
    free, across, out = np.ones((h, w + 2), np.uint8), np.ones((h + 2, w), np.uint8), np.zeros((h, w), np.uint8)
    for r in range(h):
        for c in range(w):
            free[r, c + 1] = smooth[r, c]
    for _ in range(most):
        for r in range(h):
            for c in range(w):
                across[r + 1, c] = free[r, c] & free[r, c + 1] & free[r, c + 2]
        for r in range(h):
            for c in range(w):
                free[r, c + 1] = across[r, c] & across[r + 1, c] & across[r + 2, c]
            for c in range(w):
                out[r, c] += free[r, c + 1]
    return out


@kernel
def _decimetres(above: Records, below: Records, out: I32) -> None:
    """Mean depth (w,) of the blocks between two rows (w + 1,) of the integral images, in whole decimetres; -1 without depth."""
    for c in range(len(out)):
        n = below[c + 1]["n"] - above[c + 1]["n"] - below[c]["n"] + above[c]["n"]
        z = (below[c + 1]["z"] - above[c + 1]["z"] - below[c]["z"] + above[c]["z"]) / max(n, 1.0)
        out[c] = np.int32(min(10.0 * z, 1e6)) if n > 0.5 else -1


@kernel
def _box_sums(flat: F64, a: int, b: int, c: int, d: int, out: F64, first: int, n: int) -> None:
    """Sums over boxes side by side, given by the places of their corners in the flat rows of the integral images: a − b − c + d. Numbers that cannot
    be negative need no test for indices that count from the end, so the compiler takes several at once."""
    i, j, k, m, o = np.uint64(a), np.uint64(b), np.uint64(c), np.uint64(d), np.uint64(first)
    for t in range(np.uint64(n)):
        out[o + t] = flat[i + t] - flat[j + t] - flat[k + t] + flat[m + t]


@kernel
def _box_sum(flat: F64, a: int, b: int, c: int, d: int, out: F64, first: int) -> None:
    """`_box_sums` of one box."""
    i, j, k, m, o = np.uint64(a), np.uint64(b), np.uint64(c), np.uint64(d), np.uint64(first)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    out[o], out[o + one] = flat[i] - flat[j] - flat[k] + flat[m], flat[i + one] - flat[j + one] - flat[k + one] + flat[m + one]
    out[o + two] = flat[i + two] - flat[j + two] - flat[k + two] + flat[m + two]
    out[o + three] = flat[i + three] - flat[j + three] - flat[k + three] + flat[m + three]


@kernel
def _halves(flat: F64, kept: int, h: int, w: int, r: int, first: int, end: int, k: int, least: float, halves: F64, needed: F64) -> None:
    """Sum over the half patches, k blocks to each side, of the blocks first … end of a row; only that of a single block may be cut by the image."""
    row, side, place, n = 4 * (w + 1), 4 * w, 4 * first, 4 * (end - first)
    r0, r1, c0, c1 = max(r - k, 0), min(r + k + 1, h), max(first - k, 0), min(first + k + 1, w)
    a, b = (r1 - r0) // 2, (c1 - c0) // 2
    top, bottom, upper, lower = row * (r0 % kept), row * (r1 % kept), row * ((r0 + a) % kept), row * ((r1 - a) % kept)
    west, east, t = 4 * c0, 4 * c1, 4 * b
    if n == 4:  # a single block, as most stretches are: nothing to prepare for many
        _box_sum(flat, bottom + east, top + east, bottom + east - t, top + east - t, halves, place)
        _box_sum(flat, bottom + west + t, top + west + t, bottom + west, top + west, halves, place + side)
        _box_sum(flat, bottom + east, lower + east, bottom + west, lower + west, halves, place + 2 * side)
        _box_sum(flat, upper + east, top + east, upper + west, top + west, halves, place + 3 * side)
    else:
        _box_sums(flat, bottom + east, top + east, bottom + east - t, top + east - t, halves, place, n)
        _box_sums(flat, bottom + west + t, top + west + t, bottom + west, top + west, halves, place + side, n)
        _box_sums(flat, bottom + east, lower + east, bottom + west, lower + west, halves, place + 2 * side, n)
        _box_sums(flat, upper + east, top + east, upper + west, top + west, halves, place + 3 * side, n)
    for c in range(first, end):
        needed[0, c] = max(least * (r1 - r0) * b, 1.0)
        needed[1, c] = max(least * (c1 - c0) * a, 1.0)


@kernel
def _normals_of_row(
    east: Records, west: Records, south: Records, north: Records, needed: F64, intrinsics: tuple[float, float, float, float], out: Records
) -> None:
    """Unit normals (w,) of a row of patches: vertical × horizontal tangent, each the difference of two mean points times their counts."""
    fx, fy, cx, cy = intrinsics
    fx, fy = 1.0 / fx, 1.0 / fy
    across, down = needed[0], needed[1]
    for c in range(len(out)):
        p, q, s, t = east[c]["n"], west[c]["n"], south[c]["n"], north[c]["n"]
        zu, zv = east[c]["z"] * q - west[c]["z"] * p, south[c]["z"] * t - north[c]["z"] * s
        xu, xv = east[c]["uz"] * q - west[c]["uz"] * p, south[c]["uz"] * t - north[c]["uz"] * s
        yu, yv = east[c]["vz"] * q - west[c]["vz"] * p, south[c]["vz"] * t - north[c]["vz"] * s
        xu, yu, xv, yv = (xu - cx * zu) * fx, (yu - cy * zu) * fy, (xv - cx * zv) * fx, (yv - cy * zv) * fy
        nx, ny, nz = yv * zu - zv * yu, zv * xu - xv * zu, xv * yu - yv * xu
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        found = (min(p, q) >= across[c]) & (min(s, t) >= down[c]) & (length > 0.0)
        scale = 1.0 / length if found else np.nan
        out[c]["x"], out[c]["y"], out[c]["z"] = nx * scale, ny * scale, nz * scale
