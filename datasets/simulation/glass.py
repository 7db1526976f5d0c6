"""Mirrors and panes of glass as a camera with active depth sees them: a mirror shows, and measures, what it reflects; a pane between rooms is seen
through unless it is seen at a slant; one to the outside returns no depth."""

from __future__ import annotations

import numpy as np
from numba import njit

from trihedron.datasets.simulation.raytracing import CameraView, Geometry, hit, view_of
from trihedron.datasets.simulation.room import Glass, Pane
from trihedron.datasets.simulation.shading import Atlas, color_at
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, U8, Bool, Camera

SLANT_COSINE = 0.5  # of incidence, below which the light of the projector does not come back through a pane
TRANSMITTED = 0.92  # of the light of what is behind a pane
NEAREST_M = 0.01  # of a camera to a pane


def look_through(
    panes: tuple[Pane, ...], geometry: Geometry, atlas: Atlas, camera: Camera, T_world_camera: F64, color: U8, depth: F64, cosine: F32
) -> Bool:
    """Change (h, w, 3) RGB, (h, w) depth and (h, w) cosine of incidence of a view to what the panes let it see; returns (h, w) where no light of the
    projector comes back. What is reflected twice is left out."""
    view, lost = view_of(geometry, camera, T_world_camera), np.zeros(depth.shape, np.bool_)
    opaque = depth.copy()
    for pane in panes:
        away = float(matmul(pane.normal, view.position - pane.origin))
        if pane.kind is Glass.mirror:
            if away > NEAREST_M:
                _reflect(geometry, atlas, view, _numbers_of(pane), away, opaque, depth, color, cosine)
        elif abs(away) > NEAREST_M:
            _glaze(view, _numbers_of(pane), away, pane.kind is Glass.outer, opaque, color, lost)
    return lost


def _numbers_of(pane: Pane) -> F64:
    """Return (14,) origin, u, v, normal, width and height."""
    return np.array([*pane.origin, *pane.u, *pane.v, *pane.normal, *pane.size_m])


@njit(cache=True, nogil=True, error_model="numpy")
def _crossing(view: CameraView, pane: F64, away: float, dx: float, dy: float) -> tuple[float, float]:
    """Depth at which the ray (dx, dy, 1) meets a pane, infinity where it misses it, and the rate at which it nears its plane."""
    rate, u, v = 0.0, 0.0, 0.0
    t = np.inf
    for i in range(3):
        rate += pane[9 + i] * (view.R_world_camera[i, 0] * dx + view.R_world_camera[i, 1] * dy + view.R_world_camera[i, 2])
    if rate * away >= 0.0:
        return t, rate
    t = -away / rate
    for i in range(3):
        d = view.R_world_camera[i, 0] * dx + view.R_world_camera[i, 1] * dy + view.R_world_camera[i, 2]
        p = view.position[i] + t * d - pane[i]
        u += pane[3 + i] * p
        v += pane[6 + i] * p
    return (t if 0.0 <= u <= pane[12] and 0.0 <= v <= pane[13] else np.inf), rate


@njit(cache=True, nogil=True, error_model="numpy")
def _glaze(view: CameraView, pane: F64, away: float, opaque_to_projector: bool, opaque: F64, color: U8, lost: Bool) -> None:
    """Darken what is behind a pane, and mark where its depth is lost."""
    h, w = opaque.shape
    for y in range(h):
        dy = (y - view.cy) / view.fy
        for x in range(w):
            dx = (x - view.cx) / view.fx
            t, rate = _crossing(view, pane, away, dx, dy)
            if t < opaque[y, x]:
                for c in range(3):
                    color[y, x, c] = np.uint8(TRANSMITTED * color[y, x, c])
                lost[y, x] |= opaque_to_projector or abs(rate) < SLANT_COSINE * np.sqrt(dx * dx + dy * dy + 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _reflect(geometry: Geometry, atlas: Atlas, view: CameraView, pane: F64, away: float, opaque: F64, depth: F64, color: U8, cosine: F32) -> None:
    """Show in a mirror what it reflects, as far away as the light goes: what the mirrored camera sees from behind it."""
    h, w = opaque.shape
    R, n = view.R_world_camera, pane[9:12]
    position, turned = np.empty(3), np.empty((3, 3))
    for i in range(3):
        position[i] = view.position[i] - 2.0 * away * n[i]
        for j in range(3):
            turned[i, j] = R[i, j] - 2.0 * n[i] * (n[0] * R[0, j] + n[1] * R[1, j] + n[2] * R[2, j])
    origin, direction, row = np.empty(3), np.empty(3), np.zeros(16)
    for y in range(h):
        dy = (y - view.cy) / view.fy
        for x in range(w):
            dx = (x - view.cx) / view.fx
            t, _ = _crossing(view, pane, away, dx, dy)
            if t >= opaque[y, x]:
                continue
            for i in range(3):
                origin[i] = view.position[i] + t * (R[i, 0] * dx + R[i, 1] * dy + R[i, 2])
                direction[i] = turned[i, 0] * dx + turned[i, 1] * dy + turned[i, 2]
            further, face = _first_hit(geometry, origin, direction, row)
            whole = t + further
            red, green, blue, c = color_at(
                geometry.faces, atlas.texels, atlas.levels, atlas.per_metre, position, turned, dx, dy, whole, whole / view.fx, face
            )
            depth[y, x], cosine[y, x] = whole, c
            color[y, x, 0], color[y, x, 1], color[y, x, 2] = np.uint8(red + 0.5), np.uint8(green + 0.5), np.uint8(blue + 0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _first_hit(geometry: Geometry, origin: F64, direction: F64, row: F64) -> tuple[float, int]:
    """Parameter and face of what a ray from a point within the room meets first; `row` (16,) is room for a solid as `CameraView` has it."""
    best, face = np.inf, 0
    for p in range(len(geometry.planes)):
        plane = geometry.planes[p]
        rate = plane[0] * direction[0] + plane[1] * direction[1] + plane[2] * direction[2]
        if rate < 0.0:
            t = -(plane[0] * origin[0] + plane[1] * origin[1] + plane[2] * origin[2] + plane[3]) / rate
            if t < best:
                best, face = t, p
    for s in range(len(geometry.kinds)):
        R, centre = geometry.rotations[s], geometry.centres[s]
        for i in range(3):
            row[i] = geometry.halves[s, i]
            row[3 + i] = row[8 + 3 * i] = 0.0
            for j in range(3):
                row[3 + i] += R[j, i] * (origin[j] - centre[j])
                row[8 + 3 * i] += R[j, i] * direction[j]
        row[15] = geometry.kinds[s]
        t, number = hit(row, 0.0, 0.0)
        if t < best:
            best, face = t, geometry.first_face[s] + number
    return best, face
