"""The colours of points of a surface, from the views that see them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trihedron.pipeline.core.types import F64, U8, Bool
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.surface.vertex_colors_kernels import paint

NEAR_M, VISIBLE_SIGMAS = 0.03, 3.0  # a point is seen where the depth read differs by no more than NEAR_M and SIGMAS standard deviations from its own
UNSEEN = 128
MOST = 48  # views; what one sees its neighbours see too


def view_colors(points: F64, normals: F64, views: Sequence[tuple[KeyframeView, F64]]) -> tuple[U8, Bool]:
    """(n, 3) RGB of points with unit normals (n, 3), the mean over the views that see them, those that see them large by far the most; and whether
    any does: UNSEEN grey if none. Of more than MOST views as many are asked, evenly."""
    points32, normals32 = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(normals, np.float32)
    total = np.zeros((len(points), 4), np.float32)
    for row in np.unique(np.linspace(0, max(len(views) - 1, 0), min(MOST, len(views))).round().astype(int)):
        view, T = views[row]
        c = view.camera
        intrinsics = c.intrinsics.astype(np.float32)
        near = (NEAR_M + VISIBLE_SIGMAS * c.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.1))).astype(np.float32)
        paint(points32, normals32, view.depth_m, view.color, T[:3, :3].T.astype(np.float32), T[:3, 3].astype(np.float32), intrinsics, near, total)
    seen = total[:, 3] > 0.0
    colors = np.rint(total[:, :3] / np.maximum(total[:, 3:], 1e-20))
    return np.where(seen[:, None], colors, UNSEEN).astype(np.uint8), seen


def fill_unseen(points: F64, colors: U8, seen: Bool) -> U8:
    """The colours (n, 3), those of points that are not seen (the image ends before their mesh does) from the nearest that is."""
    from scipy.spatial import cKDTree

    if seen.all() or not seen.any():
        return colors
    out = colors.copy()
    out[~seen] = colors[seen][cKDTree(points[seen]).query(points[~seen])[1]]
    return out
