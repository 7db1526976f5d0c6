"""Colour for the ray tracer: mip-mapped textures, a lamp, and smooth borders.

Colour is sampled once a pixel, and SUBPIXELS² times where a neighbour shows another face, so that edges look as a camera shows them.
"""
# mypy: disable-error-code="arg-type"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trihedron.datasets.simulation.raytracing import CameraView, Geometry, nearest, trace, view_of
from trihedron.datasets.simulation.room import BOX, CYLINDER
from trihedron.pipeline.core.types import F32, F64, I32, U8, Camera

AMBIENT, DIFFUSE, SKY = 0.55, 0.70, 0.12  # light: everywhere, from the lamp, by the direction of the surface
LAMP_REACH_M = 2.6  # distance at which the lamp's light has halved
SKY_DIRECTION = (0.55, -0.35, 0.75)  # gives every direction of the room its own brightness
SCALES = tuple(0.5**level for level in range(16))  # of a texture's halved copies
SUBPIXELS = 3  # samples a side in border pixels


class Atlas(NamedTuple):
    """Textures with their halved copies in one run of bytes. Row f of `levels` holds, for each level, offset, width and height."""

    texels: U8
    levels: NDArray[np.int64]  # (f, l, 3)
    per_metre: F64  # (f,) texels of level 0


def render(geometry: Geometry, atlas: Atlas, camera: Camera, T_world_camera: F64) -> tuple[U8, F64, I32, F32]:
    """(h, w, 3) RGB, (h, w) depth in metres, (h, w) face numbers and (h, w) cosine of the angle of incidence, seen from a pose."""
    view = view_of(geometry, camera, T_world_camera)
    depth = np.empty((camera.height, camera.width))
    faces = np.empty((camera.height, camera.width), dtype=np.int32)
    color = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    cosine = np.empty((camera.height, camera.width), dtype=np.float32)
    trace(geometry, view, depth, faces)
    _shade(geometry.faces, atlas, view, depth, faces, color, cosine)
    _smooth_borders(geometry, atlas, view, faces, color)
    return color, depth, faces, cosine


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(surfaces: F64, atlas: Atlas, view: CameraView, depth: F64, faces: I32, color: U8, cosine: F32) -> None:
    """Colour and cosine of incidence of every pixel."""
    texels, levels, per_metre, position, R = atlas.texels, atlas.levels, atlas.per_metre, view.position, view.R_world_camera
    per_px = 1.0 / view.fx
    h, w = depth.shape
    for y in range(h):
        dy = (y - view.cy) / view.fy
        for x in range(w):
            dx, t = (x - view.cx) * per_px, depth[y, x]
            r, g, b, c = color_at(surfaces, texels, levels, per_metre, position, R, dx, dy, t, t * per_px, np.int64(faces[y, x]))
            color[y, x, 0], color[y, x, 1], color[y, x, 2] = np.uint8(r + 0.5), np.uint8(g + 0.5), np.uint8(b + 0.5)
            cosine[y, x] = c


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def color_at(
    surfaces: F64, texels: U8, levels: NDArray[np.int64], per_metre: F64, position: F64, R: F64,
    dx: float, dy: float, t: float, pixel_m: float, face: int,
) -> tuple[float, float, float, float]:  # fmt: skip
    """RGB (0..255) and cosine of incidence where the ray (dx, dy, 1) meets a face at depth t: albedo × (ambient + Lambert)."""
    d0, d1, d2 = R[0, 0] * dx + R[0, 1] * dy + R[0, 2], R[1, 0] * dx + R[1, 1] * dy + R[1, 2], R[2, 0] * dx + R[2, 1] * dy + R[2, 2]
    p0, p1, p2 = position[0] + t * d0, position[1] + t * d1, position[2] + t * d2
    n0, n1, n2, u, v = _surface(surfaces, face, p0, p1, p2)
    cosine = max(0.0, -(n0 * d0 + n1 * d1 + n2 * d2) / math.sqrt(dx * dx + dy * dy + 1.0))
    r, g, b = _sample(texels, levels, per_metre[face], face, u, v, pixel_m * pixel_m / max(cosine, 0.1))
    l0, l1, l2 = surfaces[face, 14] - p0, surfaces[face, 15] - p1, surfaces[face, 16] - p2
    squared = l0 * l0 + l1 * l1 + l2 * l2
    lambert = max(0.0, n0 * l0 + n1 * l1 + n2 * l2) / (math.sqrt(squared) * (1.0 + squared * (1.0 / (LAMP_REACH_M * LAMP_REACH_M))))
    light = AMBIENT + DIFFUSE * lambert + SKY * (n0 * SKY_DIRECTION[0] + n1 * SKY_DIRECTION[1] + n2 * SKY_DIRECTION[2])
    return min(255.0, r * light), min(255.0, g * light), min(255.0, b * light), cosine


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _surface(surfaces: F64, face: int, p0: float, p1: float, p2: float) -> tuple[float, float, float, float, float]:
    """Unit normal and texture coordinates (metres) of a point on a face."""
    q0, q1, q2 = p0 - surfaces[face, 0], p1 - surfaces[face, 1], p2 - surfaces[face, 2]
    if surfaces[face, 12] == BOX:
        u = q0 * surfaces[face, 3] + q1 * surfaces[face, 4] + q2 * surfaces[face, 5]
        v = q0 * surfaces[face, 6] + q1 * surfaces[face, 7] + q2 * surfaces[face, 8]
        return surfaces[face, 9], surfaces[face, 10], surfaces[face, 11], u, v
    radius = surfaces[face, 13]
    around = radius * (math.atan2(q1, q0) + math.pi)
    if surfaces[face, 12] == CYLINDER:
        return q0 / radius, q1 / radius, 0.0, around, -q2
    return q0 / radius, q1 / radius, q2 / radius, around, radius * math.acos(max(-1.0, min(1.0, q2 / radius)))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _sample(
    texels: U8, levels: NDArray[np.int64], per_metre: float, face: int, u: float, v: float, footprint_m2: float
) -> tuple[float, float, float]:
    """Trilinear texture look-up (RGB, 0..255) at (u, v) metres for a pixel that covers `footprint_m2`."""
    covered = footprint_m2 * per_metre * per_metre
    if covered <= 1.0:
        return _bilinear(texels, levels, face, np.int64(0), u * per_metre, v * per_metre)
    level = 0.5 * math.log2(covered)
    last = levels.shape[1] - 1
    low = min(int(level), last)
    r, g, b = _bilinear(texels, levels, face, low, u * per_metre, v * per_metre)
    share = level - low
    if low == last or share < 0.01:
        return r, g, b
    r2, g2, b2 = _bilinear(texels, levels, face, low + 1, u * per_metre, v * per_metre)
    return r + share * (r2 - r), g + share * (g2 - g), b + share * (b2 - b)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _bilinear(t: U8, levels: NDArray[np.int64], face: int, level: int, x: float, y: float) -> tuple[float, float, float]:
    """One level of texels `t` at (x, y) texels of level 0, clamped at the texture's border."""
    offset, w, h = levels[face, level, 0], levels[face, level, 1], levels[face, level, 2]
    scale = SCALES[level]
    x = min(max(x * scale - 0.5, 0.0), w - 1.001)
    y = min(max(y * scale - 0.5, 0.0), h - 1.001)
    i, j = int(x), int(y)
    a, b = x - i, y - j
    p = offset + 3 * (j * w + i)
    s = p + 3 * w
    w00, w10, w01, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    return (
        w00 * t[p] + w10 * t[p + 3] + w01 * t[s] + w11 * t[s + 3],
        w00 * t[p + 1] + w10 * t[p + 4] + w01 * t[s + 1] + w11 * t[s + 4],
        w00 * t[p + 2] + w10 * t[p + 5] + w01 * t[s + 2] + w11 * t[s + 5],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_borders(geometry: Geometry, atlas: Atlas, view: CameraView, faces: I32, color: U8) -> None:
    """Average SUBPIXELS² samples where a pixel and one of its neighbours show different faces, among the solids these faces belong to."""
    h, w = faces.shape
    solids = np.empty(9, dtype=np.int64)
    seen = np.empty((SUBPIXELS * SUBPIXELS, 5))
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            f = faces[y, x]
            if faces[y, x - 1] != f or faces[y, x + 1] != f or faces[y - 1, x] != f or faces[y + 1, x] != f:
                count = _solids_around(geometry.solid_of_face, faces, x, y, solids)
                _smooth_pixel(geometry, atlas, view, solids, count, seen, x, y, color)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _smooth_pixel(
    geometry: Geometry, atlas: Atlas, view: CameraView, solids: NDArray[np.int64], count: int, seen: F64, x: int, y: int, color: U8
) -> None:
    """Find the faces in a pixel and colour each once, at the middle of its samples. `seen` is room for rows (face, samples, sums of dx, dy, t)."""
    found, samples = 0, SUBPIXELS * SUBPIXELS
    for i in range(samples):
        dx = (x + (i % SUBPIXELS + 0.5) / SUBPIXELS - 0.5 - view.cx) / view.fx
        dy = (y + (i // SUBPIXELS + 0.5) / SUBPIXELS - 0.5 - view.cy) / view.fy
        t, face = nearest(view.room, view.solids, geometry.first_face, solids, count, dx, dy)
        k = 0
        while k < found and seen[k, 0] != face:
            k += 1
        if k == found:
            found += 1
            seen[k, 0], seen[k, 1], seen[k, 2], seen[k, 3], seen[k, 4] = face, 0.0, 0.0, 0.0, 0.0
        seen[k, 1] += 1.0
        seen[k, 2] += dx
        seen[k, 3] += dy
        seen[k, 4] += t
    r = g = b = 0.0
    for k in range(found):
        n, share = seen[k, 1], seen[k, 1] / samples
        r1, g1, b1, _ = color_at(
            geometry.faces, atlas.texels, atlas.levels, atlas.per_metre, view.position, view.R_world_camera,
            seen[k, 2] / n, seen[k, 3] / n, seen[k, 4] / n, seen[k, 4] / n / view.fx, int(seen[k, 0]),
        )  # fmt: skip
        r, g, b = r + share * r1, g + share * g1, b + share * b1
    color[y, x, 0], color[y, x, 1], color[y, x, 2] = np.uint8(r + 0.5), np.uint8(g + 0.5), np.uint8(b + 0.5)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _solids_around(solid_of_face: I32, faces: I32, x: int, y: int, solids: NDArray[np.int64]) -> int:
    """The different solids seen in the 3 × 3 neighbourhood, into `solids`; returns how many."""
    count = 0
    for j in range(y - 1, y + 2):
        for i in range(x - 1, x + 2):
            s = solid_of_face[faces[j, i]]
            known = s < 0
            for k in range(count):
                known = known or solids[k] == s
            if not known:
                solids[count] = s
                count += 1
    return count
