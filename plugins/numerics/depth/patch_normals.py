"""Surface normals from tangent vectors averaged over image patches, by integral images (Holzer et al., IROS 2012)."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, U8, Camera

Sums = tuple[float, float, float, float]  # count, Σz, Σuz, Σvz


def patch_sides(camera: Camera, noise_deg: float, least_px: float, most_px: float) -> F64:
    """(100,) side in px of the patch whose normal has a predicted standard deviation of `noise_deg`, for depths of 0.1, 0.2 … 10 m, within bounds.

    The tangents of n × n px with independent depth noise σ at z have slopes of σ f / z · √12 / n² (least squares, to 7 %)."""
    z = np.arange(1, 101) * 0.1
    slope = camera.depth_noise.sigma_m(z) * camera.fx / z
    side = np.sqrt(np.sqrt(12.0) * slope / np.radians(noise_deg))
    return np.asarray(np.clip(side, least_px, most_px))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def block_sums(depth: F32, stride: int, reach: int, jump: float, jump_m: float) -> tuple[F64, U8]:
    """Sums over blocks of stride × stride pixels, as integral images, and which blocks are free of depth edges.

    Returns (h+1, w+1, 4) integral images of (count, Σz, Σuz, Σvz) over pixels with depth, and (h, w) 0 where a block holds a depth edge, else 1.
    An edge is two pixels in a row or column, `reach` px apart at most and nothing measured between, that differ by more than `jump·z + jump_m`."""
    rows, cols = depth.shape
    h, w = (rows + stride - 1) // stride, (cols + stride - 1) // stride
    sums = np.zeros((h + 1, w + 1, 4))
    smooth = np.ones((h, w), np.uint8)
    above = np.zeros(cols, np.float32)
    above_row = np.full(cols, -reach - 1, np.int32)
    for y in range(rows):
        r = y // stride
        left = np.float32(0.0)
        left_col = -reach - 1
        for c in range(w):
            n, total, along, down = sums[r + 1, c + 1, 0], sums[r + 1, c + 1, 1], sums[r + 1, c + 1, 2], sums[r + 1, c + 1, 3]
            for x in range(c * stride, min((c + 1) * stride, cols)):
                z = depth[y, x]
                if not (z > 0.0 and z < np.inf):
                    continue
                n += 1.0
                total += z
                along += x * z
                down += y * z
                if x - left_col <= reach and abs(z - left) > jump * min(z, left) + jump_m:
                    smooth[r, c] = 0
                    smooth[r, left_col // stride] = 0
                if y - above_row[x] <= reach and abs(z - above[x]) > jump * min(z, above[x]) + jump_m:
                    smooth[r, c] = 0
                    smooth[above_row[x] // stride, c] = 0
                left, left_col, above[x], above_row[x] = z, x, z, y
            sums[r + 1, c + 1, 0], sums[r + 1, c + 1, 1], sums[r + 1, c + 1, 2], sums[r + 1, c + 1, 3] = n, total, along, down
    _integrate(sums)
    return sums, smooth


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _integrate(sums: F64) -> None:
    """Running sums along both axes, in place."""
    h, w = sums.shape[:2]
    for r in range(1, h):
        n, total, along, down = 0.0, 0.0, 0.0, 0.0
        for c in range(1, w):
            n, total, along, down = n + sums[r, c, 0], total + sums[r, c, 1], along + sums[r, c, 2], down + sums[r, c, 3]
            sums[r, c, 0], sums[r, c, 1] = sums[r - 1, c, 0] + n, sums[r - 1, c, 1] + total
            sums[r, c, 2], sums[r, c, 3] = sums[r - 1, c, 2] + along, sums[r - 1, c, 3] + down


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box(sums: F64, a: int, b: int, c: int, d: int) -> Sums:
    """The sums over a box of blocks, given by its corners' places in the flat `sums`: a − b − c + d."""
    return (
        sums[a] - sums[b] - sums[c] + sums[d],
        sums[a + 1] - sums[b + 1] - sums[c + 1] + sums[d + 1],
        sums[a + 2] - sums[b + 2] - sums[c + 2] + sums[d + 2],
        sums[a + 3] - sums[b + 3] - sums[c + 3] + sums[d + 3],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _tangent(p: Sums, q: Sums) -> tuple[float, float, float]:
    """Mean (z, uz, vz) of one box less that of another, times the product of their counts."""
    return p[1] * q[0] - q[1] * p[0], p[2] * q[0] - q[2] * p[0], p[3] * q[0] - q[3] * p[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def patch_normals(sums: F64, clearance: F32, radii: I32, least: float, intrinsics: tuple[float, float, float, float]) -> F32:
    """(h, w, 3) unit normals towards the camera; NaN where a block has no depth or no patch free of depth edges.

    `clearance` (h, w) is the chessboard distance to the nearest block with a depth edge; `radii[i]` the patch's half-width in blocks at a depth of
    i decimetres (the last entry serves beyond); `least` points are needed per block of half a patch, on average. Any difference of mean points of a
    plane lies in the plane, so missing pixels do not bias the normal. The mean of a patch's right half less that of its left half is the mean of
    its horizontal tangents, likewise for the vertical ones."""
    h, w = clearance.shape
    fx, fy, cx, cy = intrinsics
    fx, fy = 1.0 / fx, 1.0 / fy
    out = np.full((h, w, 3), np.nan, np.float32)
    flat, row = sums.reshape(-1), 4 * (w + 1)
    for r in range(h):
        for c in range(w):
            i = r * row + 4 * c
            n = flat[i + row + 4] - flat[i + 4] - flat[i + row] + flat[i]
            if n < 0.5:
                continue
            z = (flat[i + row + 5] - flat[i + 5] - flat[i + row + 1] + flat[i + 1]) / n
            k = min(radii[min(int(10.0 * z), len(radii) - 1)], int(clearance[r, c]) - 1)
            if k <= 0:
                continue
            r0, r1, c0, c1 = max(r - k, 0), min(r + k + 1, h), max(c - k, 0), min(c + k + 1, w)
            a, b = (r1 - r0) // 2, (c1 - c0) // 2
            nw, ne, sw, se = r0 * row + 4 * c0, r0 * row + 4 * c1, r1 * row + 4 * c0, r1 * row + 4 * c1
            s, t = a * row, 4 * b
            east = _box(flat, se, ne, se - t, ne - t)
            west = _box(flat, sw + t, nw + t, sw, nw)
            if min(east[0], west[0]) < max(least * (r1 - r0) * b, 1.0):
                continue
            south = _box(flat, se, se - s, sw, sw - s)
            north = _box(flat, ne + s, ne, nw + s, nw)
            if min(south[0], north[0]) < max(least * (c1 - c0) * a, 1.0):
                continue
            zu, xu, yu = _tangent(east, west)
            zv, xv, yv = _tangent(south, north)
            xu, yu, xv, yv = (xu - cx * zu) * fx, (yu - cy * zu) * fy, (xv - cx * zv) * fx, (yv - cy * zv) * fy
            nx, ny, nz = yv * zu - zv * yu, zv * xu - xv * zu, xv * yu - yv * xu  # vertical × horizontal: towards the camera
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 0.0:
                length = 1.0 / length
                out[r, c, 0], out[r, c, 1], out[r, c, 2] = nx * length, ny * length, nz * length
    return out
