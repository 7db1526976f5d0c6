"""A picture of a surface, seen from above, from the side that shows most: as coloured by the views, and each plane in a colour of its own.

Triangles are seen from their front alone, so the walls and the ceiling that stand in the way do not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, U8, Surface
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.export import Format
from trihedron.tools.export_surface import surface_of, upright

SIZE = (560, 560)  # px, of each half
ELEVATION_DEG, AZIMUTHS = 35.0, 24  # height of the viewer, and the directions that are tried
PAPER, LIGHT, SHADE = 255, 0.72, 0.28


def write_picture(recording: Recording, path: Path) -> str:
    """PNG: two views side by side."""
    surface = surface_of(recording)
    vertices = surface.vertices_m @ upright(surface.up).T
    triangle, weights, shade = _seen(vertices, surface.triangles)
    rng = np.random.default_rng(0)
    tints = np.concatenate([rng.integers(70, 250, (len(surface.plane_ids), 3)), [[150, 150, 150]]]).astype(np.float64)
    halves = []
    for color in (_colors(surface, triangle, weights), tints[surface.instances[triangle]] if len(surface.triangles) else np.zeros((*SIZE[::-1], 3))):
        halves.append(np.where((triangle >= 0)[..., None], color * shade[..., None], PAPER))
    picture = np.clip(np.concatenate(halves, axis=1), 0, 255).astype(np.uint8)
    path.write_bytes(bytes(cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]))
    return f"{picture.shape[1]} × {picture.shape[0]} px, the surface as it was seen and by planes" if len(surface.triangles) else "empty: no surface"


def _seen(vertices: F64, triangles: I32) -> tuple[I32, F64, F64]:
    """(h, w) triangle seen in a pixel, -1 = none, (h, w, 3) its weights of the corners, and (h, w) how light it is."""
    w, h = SIZE
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    e, a = np.radians(ELEVATION_DEG), np.arange(AZIMUTHS) * 2.0 * np.pi / AZIMUTHS
    directions = np.stack([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.full(AZIMUTHS, -np.sin(e))], axis=1)
    ahead = directions[np.argmax(np.maximum(-normals @ directions.T, 0.0).sum(axis=0))]
    right = np.array([ahead[1], -ahead[0], 0.0]) / np.hypot(ahead[0], ahead[1])
    points = vertices @ np.stack([right, np.cross(ahead, right), ahead]).T
    triangle, weights = np.full((h, w), -1, np.int32), np.zeros((h, w, 3))
    if len(triangles) == 0:
        return triangle, weights, np.zeros((h, w))
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    scale = 0.96 * min(np.array([w, h]) / np.maximum(high - low, 1e-6))
    points[:, :2] = (points[:, :2] - 0.5 * (low + high)) * scale + 0.5 * np.array([w, h])
    _rasterise(points, triangles, triangle, weights)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    lit = LIGHT + SHADE * normals @ np.array([0.3, -0.5, 0.8])
    return triangle, weights, lit[triangle]


@kernel(error_model="python")
def _rasterise(points: F64, triangles: I32, triangle: I32, weights: F64) -> None:
    """Fill the nearest front-facing triangle of each pixel; x right, y down, z away."""
    h, w = triangle.shape
    nearest = np.full((h, w), np.inf)
    for t in range(len(triangles)):
        a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area >= 0.0:  # y points down, so anticlockwise is negative
            continue
        x0, x1 = max(int(min(a[0], b[0], c[0])), 0), min(int(max(a[0], b[0], c[0])) + 1, w - 1)
        y0, y1 = max(int(min(a[1], b[1], c[1])), 0), min(int(max(a[1], b[1], c[1])) + 1, h - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                s = 1.0 - u - v
                if u < -1e-9 or v < -1e-9 or s < -1e-9:
                    continue
                z = u * a[2] + v * b[2] + s * c[2]
                if z < nearest[y, x]:
                    nearest[y, x], triangle[y, x] = z, t
                    weights[y, x, 0], weights[y, x, 1], weights[y, x, 2] = u, v, s


def _colors(surface: Surface, triangle: I32, weights: F64) -> F64:
    """(h, w, 3) RGB: of the atlas where there is a picture of the plane, else between the vertices."""
    if len(surface.triangles) == 0:
        return np.zeros((*triangle.shape, 3))
    out = np.einsum("hwk,hwkc->hwc", weights, surface.colors[surface.triangles[triangle]].astype(np.float64))
    place = np.einsum("hwk,hwkc->hwc", weights, surface.texels[triangle].astype(np.float64))
    pictured = (triangle >= 0) & np.isfinite(place[..., 0])
    x, y = np.rint(np.nan_to_num(place)).astype(int).transpose(2, 0, 1)
    atlas: U8 = surface.atlas
    out[pictured] = atlas[np.clip(y, 0, max(len(atlas) - 1, 0)), np.clip(x, 0, max(atlas.shape[1] - 1, 0))][pictured] if atlas.size else 0.0
    return np.asarray(out, np.float64)


FORMATS = (Format("png", "surface.png", write_picture),)
