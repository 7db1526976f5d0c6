"""One texture for all planes of a surface: each plane's rectangle, seen from its front, in rows on a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.surface.plane_axes import plane_axes
from trihedron.plugins.surface.vertex_colors import UNSEEN, view_colors

MARGIN = 1  # texels about each rectangle, so that none bleeds into its neighbour
NARROWEST = 256  # texels of a page


@dataclass(frozen=True)
class Atlas:
    """(h, w, 3) RGB, (t, 3, 2) texels (x, y) of the corners of triangles, NaN for those of no plane, and the (p, 3) mean colours of the planes."""

    image: U8
    texels: F32
    colors: U8


def bake_atlas(
    vertices: F64, triangles: I32, labels: NDArray[np.signedinteger], planes: F64, views: Sequence[tuple[KeyframeView, F64]], texel_m: float
) -> Atlas:  # fmt: skip
    """Paint planes (p, 4) at `texel_m` a texel where their triangles are."""
    texels = np.full((len(triangles), 3, 2), np.nan, np.float32)
    axes = [plane_axes(plane) for plane in planes]
    corners, sizes = [], []
    for p, basis in enumerate(axes):
        mine = labels == p
        flat = matmul(vertices[triangles[mine]], basis) / texel_m
        low = np.floor(flat.reshape(-1, 2).min(axis=0)) - MARGIN if mine.any() else np.zeros(2)
        texels[mine] = flat - low
        corners.append(low)
        sizes.append(np.ceil(texels[mine].reshape(-1, 2).max(axis=0)).astype(int) + 1 + MARGIN if mine.any() else np.zeros(2, int))
    places, (width, height) = _pack(np.array(sizes, int).reshape(-1, 2))
    image, colors = np.zeros((height, width, 3), np.uint8), np.zeros((len(planes), 3), np.uint8)
    for p, (plane, basis) in enumerate(zip(planes, axes)):
        (w, h), (x, y) = sizes[p], places[p]
        if w == 0:
            continue
        covered = _covered_texels(texels[labels == p], w, h)
        grid = np.stack(np.nonzero(covered)[::-1], axis=1) + corners[p]
        points = matmul(grid * texel_m, basis.T) - plane[3] * plane[:3]
        found, seen = view_colors(points, np.broadcast_to(plane[:3], points.shape), views)
        picture, known = np.full((h, w, 3), UNSEEN, np.uint8), np.zeros((h, w), np.bool_)
        picture[covered], known[covered] = found, seen
        image[y : y + h, x : x + w] = _fill_unseen(picture, known)
        colors[p] = np.rint(found[seen].mean(axis=0)) if seen.any() else UNSEEN
        texels[labels == p] += np.array([x, y], np.float32)
    return Atlas(image, texels, colors)


def _covered_texels(triangles: F32, w: int, h: int) -> Bool:
    """(h, w) the texels under triangles (t, 3, 2), and those beside them."""
    mask = np.zeros((h, w), np.uint8)
    for corners in np.rint(triangles).astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 1)
    return np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0, np.bool_)


def _fill_unseen(picture: U8, seen: Bool) -> U8:
    """(h, w, 3) with the colour of the nearest texel seen where none is: triangles reach a little beyond what the views show."""
    from scipy.ndimage import distance_transform_edt

    if seen.all() or not seen.any():
        return picture
    rows, columns = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    return np.asarray(picture[rows, columns])


def _pack(sizes: I32) -> tuple[I32, tuple[int, int]]:
    """Places (n, 2) of rectangles (n, 2) on a page about as wide as high, and its size: the highest first, from left to right in rows."""
    if len(sizes) == 0:
        return np.empty((0, 2), np.int32), (0, 0)
    width = max(int(sizes[:, 0].max()), int(np.ceil(np.sqrt(1.2 * (sizes[:, 0] * sizes[:, 1]).sum()))), NARROWEST)
    places, x, y, row = np.zeros_like(sizes), 0, 0, 0
    for k in np.argsort(-sizes[:, 1], kind="stable"):
        if x + sizes[k, 0] > width:
            x, y, row = 0, y + row, 0
        places[k] = x, y
        x, row = x + int(sizes[k, 0]), max(row, int(sizes[k, 1]))
    return places, (width, y + row)
