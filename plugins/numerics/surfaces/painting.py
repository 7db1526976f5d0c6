"""The colour of points of a surface, from the views that see them."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, U8, Bool
from trihedron.plugins.numerics.surfaces.views import View

NEAR_M, SIGMAS = 0.03, 3.0  # a point is seen where the depth read differs by no more than NEAR_M and SIGMAS standard deviations from its own
UNSEEN = 128
MOST = 48  # views; what one sees its neighbours see too


def painted(points: F64, normals: F64, views: Sequence[tuple[View, F64]]) -> tuple[U8, Bool]:
    """(n, 3) RGB of points with unit normals (n, 3), the mean over the views that see them, those that see them large by far the most; and whether
    any does: UNSEEN grey if none. Of more than MOST views as many are asked, evenly."""
    points, normals = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(normals, np.float32)
    total = np.zeros((len(points), 4), np.float32)
    for row in np.unique(np.linspace(0, max(len(views) - 1, 0), min(MOST, len(views))).round().astype(int)):
        view, T = views[row]
        c = view.camera
        lens = c.intrinsics.astype(np.float32)
        near = (NEAR_M + SIGMAS * c.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.1))).astype(np.float32)
        _paint(points, normals, view.depth_m, view.color, T[:3, :3].T.astype(np.float32), T[:3, 3].astype(np.float32), lens, near, total)
    seen = total[:, 3] > 0.0
    colors = np.rint(total[:, :3] / np.maximum(total[:, 3:], 1e-20))
    return np.where(seen[:, None], colors, UNSEEN).astype(np.uint8), seen


def spread(points: F64, colors: U8, seen: Bool) -> U8:
    """The colours (n, 3), those of points that are not seen (the image ends before their mesh does) from the nearest that is."""
    from scipy.spatial import cKDTree

    if seen.all() or not seen.any():
        return colors
    out = colors.copy()
    out[~seen] = colors[seen][cKDTree(points[seen]).query(points[~seen])[1]]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint(points: F32, normals: F32, depth: F32, color: U8, R: F32, position: F32, lens: F32, near: F32, total: F32) -> None:
    """Add the colours one view gives, times their weight, and the weight, to `total` (n, 4). R is `R_camera_world`."""
    h, w = depth.shape
    for i in range(len(points)):
        gx, gy, gz = points[i, 0] - position[0], points[i, 1] - position[1], points[i, 2] - position[2]
        z = R[2, 0] * gx + R[2, 1] * gy + R[2, 2] * gz
        if z < 0.1:
            continue
        u = lens[0] * (R[0, 0] * gx + R[0, 1] * gy + R[0, 2] * gz) / z + lens[2]
        v = lens[1] * (R[1, 0] * gx + R[1, 1] * gy + R[1, 2] * gz) / z + lens[3]
        if u < 0.0 or v < 0.0 or u > w - 1.0 or v > h - 1.0:
            continue
        facing = -(normals[i, 0] * gx + normals[i, 1] * gy + normals[i, 2] * gz)
        d = depth[int(v + 0.5), int(u + 0.5)]
        if d <= 0.0 or facing <= 0.0 or abs(d - z) > near[min(int(10.0 * z), len(near) - 1)]:
            continue
        seen = facing / (gx * gx + gy * gy + gz * gz) ** 1.5  # solid angle of a unit of surface
        weight = seen * seen * seen
        x, y = min(int(u), w - 2), min(int(v), h - 2)
        a, b = u - x, v - y
        for k in range(3):
            upper = (1.0 - a) * color[y, x, k] + a * color[y, x + 1, k]
            lower = (1.0 - a) * color[y + 1, x, k] + a * color[y + 1, x + 1, k]
            total[i, k] += weight * ((1.0 - b) * upper + b * lower)
        total[i, 3] += weight
