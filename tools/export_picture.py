"""A picture of a surface, seen from above, from the side that shows most: planes in colours that differ, or as coloured by the views.

The ceiling is cut away, islands of less than `ISLAND` of the area are dropped, and the frame holds 98 % of the vertices. Triangles are seen from
their front alone, so that walls that stand in the way do not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.geometry import upright
from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, PLANE_KINDS, U8, Bool, Surface
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.export import Format
from trihedron.tools.export_surface import surface_of

SIZE = (1920, 1200)  # px, of the picture
SUPERSAMPLING = 2  # pixels drawn for one of the picture, in each direction
ELEVATION_DEG, AZIMUTHS = 40.0, 24  # height of the viewer, and the directions that are tried
ISLAND = 0.05  # share of the area below which a connected component is dropped
SPECK = 0.01  # share of the pixels drawn below which a connected component is dropped
CEILING_M = 0.05  # below the ceiling, what is cut away with it
COPLANAR_DEG, COPLANAR_M = 2.0, 0.01  # planes that differ by less share a colour
FRAMED = (0.5, 99.5)  # percentiles between two edges of the frame, which holds 98 % of the vertices
MARGIN = 0.04  # of the frame
PAPER, LIGHT, SHADE = 255.0, 0.88, 0.14
EDGE, EDGE_STEP = 0.4, 0.02  # darkness of an outline; a step in depth that is one, in parts of the picture's depth
BRIGHT = 235.0  # what the brightest hundredth of the colours becomes
REST = (205, 205, 200)  # what lies in no plane
PALETTE = np.array(
    [
        (166, 206, 227), (178, 223, 138), (251, 154, 153), (253, 191, 111), (202, 178, 214), (255, 237, 140), (127, 201, 190), (244, 165, 213),
        (141, 160, 203), (230, 171, 120), (166, 216, 84), (190, 174, 140),
    ],
    np.float64,
)  # fmt: skip


def write_planes_picture(recording: Recording, path: Path) -> str:
    """PNG: planes in colours that differ."""
    return _write_picture(recording, path, images=False)


def write_images_picture(recording: Recording, path: Path) -> str:
    """PNG: as coloured by the views."""
    return _write_picture(recording, path, images=True)


def _write_picture(recording: Recording, path: Path, images: bool) -> str:
    picture, count = draw_surface(surface_of(recording), images=images)
    write_file(path, bytes(cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]))
    size, colors = f"{picture.shape[1]} × {picture.shape[0]} px", "the images" if images else "the planes"
    return f"{size}, {count} triangles below the ceiling in the colours of {colors}" if count else f"{size}, empty: no surface"


def draw_surface(surface: Surface, size: tuple[int, int] = SIZE, images: bool = False) -> tuple[U8, int]:
    """Draw a surface, its planes or the colours of the images: (h, w, 3) RGB, and the number of triangles that are shown."""
    shown = np.flatnonzero(visible_triangles(surface)).astype(np.int32)
    w, h = size
    if len(shown) == 0:
        return np.full((h, w, 3), int(PAPER), np.uint8), 0
    points, lit = _view_vertices(surface, shown)
    low, high = _frame(points, surface.triangles[shown])
    triangle, weights, depth = _rasterise_triangles(points, surface.triangles[shown], size, low, high)
    triangle = np.where(remove_specks(triangle >= 0), shown[triangle], -1).astype(np.int32)
    if images:
        color, instance = _brighten_colors(_colors(surface, triangle, weights)), surface.instances[triangle]
    else:
        instance = _merge_coplanar(surface)[np.where(triangle >= 0, surface.instances[triangle], -1)]
        color = _tints(surface, instance)
    light = lit[triangle] * (1.0 - EDGE * _outlines(instance, depth))
    full = np.where((triangle >= 0)[..., None], color * light[..., None], PAPER).astype(np.float32)
    return np.clip(cv2.resize(full, size, interpolation=cv2.INTER_AREA), 0, 255).astype(np.uint8), len(shown)


def visible_triangles(surface: Surface) -> Bool:
    """(t,) True for the triangles that are no ceiling, lie below it, and belong to no small island of those."""
    triangles, vertices = surface.triangles, surface.vertices_m @ upright(surface.up).T
    if len(triangles) == 0:
        return np.zeros(0, bool)
    corners = vertices[triangles]
    ceiling = np.append(surface.kinds == PLANE_KINDS.index("ceiling"), False)[surface.instances]
    lowest = corners[ceiling, :, 2].min() - CEILING_M if ceiling.any() else np.inf
    below = np.asarray(~ceiling & (corners[:, :, 2].min(axis=1) < lowest))
    areas = below * 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    edges = np.concatenate([triangles[below, :2], triangles[below, 1:]])
    _, labels = connected_components(coo_array((np.ones(len(edges), bool), edges.T), shape=2 * (len(vertices),)), directed=False)
    component = labels[triangles[:, 0]]
    return np.asarray(below & (np.bincount(component, areas)[component] >= ISLAND * areas.sum()))


def _view_vertices(surface: Surface, shown: I32) -> tuple[F64, F64]:
    """(v, 3) vertices as the viewer sees them, x right, y down, z away, from where most of the area shows its front; (t,) light on the triangles."""
    vertices = surface.vertices_m @ upright(surface.up).T
    corners = vertices[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    e, a = np.radians(ELEVATION_DEG), (np.arange(AZIMUTHS) + 0.5) * 2.0 * np.pi / AZIMUTHS  # not along the walls
    directions = np.stack([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.full(AZIMUTHS, -np.sin(e))], axis=1)
    ahead = directions[np.argmax(np.maximum(-normals[shown] @ directions.T, 0.0).sum(axis=0))]
    right = np.array([ahead[1], -ahead[0], 0.0]) / np.hypot(ahead[0], ahead[1])
    R_view_file = np.stack([right, np.cross(ahead, right), ahead])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    lamp = np.array([0.35, -0.80, -0.50]) @ R_view_file  # over the viewer's right shoulder
    return vertices @ R_view_file.T, np.asarray(LIGHT + SHADE * np.clip(normals @ lamp, -1.0, 1.0))


def _frame(points: F64, triangles: I32) -> tuple[F64, F64]:
    """The (x, y) between which lie 98 % of the vertices, and as much of the area: a wall has few vertices."""
    corners = points[triangles]
    across = corners.reshape(-1, 3)
    areas = np.repeat(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1), 3)
    low, high = np.percentile(points[np.unique(triangles), :2], FRAMED, axis=0)
    for axis in (0, 1):
        order = np.argsort(across[:, axis])
        share = 100.0 * np.cumsum(areas[order]) / max(float(areas.sum()), 1e-12)
        first, last = np.searchsorted(share, FRAMED)
        low[axis] = min(low[axis], across[order[first], axis])
        high[axis] = max(high[axis], across[order[min(last, len(order) - 1)], axis])
    return low, high


def _scale(size: tuple[int, int], extent: F64) -> float:
    """Pixels per metre at which an extent (2,) fits, with a margin."""
    return (1.0 - 2.0 * MARGIN) * float(np.min(size / np.maximum(extent, 1e-6)))


def _rasterise_triangles(points: F64, triangles: I32, size: tuple[int, int], low: F64, high: F64) -> tuple[I32, F32, F32]:
    """(h, w) row of the triangle seen in a pixel, -1 = none, (h, w, 3) its weights of the corners, and (h, w) the depth from 0 to 1; supersampled."""
    w, h = (SUPERSAMPLING * side for side in size)
    away = points[np.unique(triangles), 2]
    placed = points - np.append(0.5 * (low + high), away.min())
    placed[:, :2] = placed[:, :2] * _scale((w, h), high - low) + 0.5 * np.array([w, h])
    placed[:, 2] /= max(float(np.ptp(away)), 1e-6)
    triangle, weights, depth = np.full((h, w), -1, np.int32), np.zeros((h, w, 3), np.float32), np.full((h, w), np.inf, np.float32)
    _rasterise(placed, triangles, triangle, weights, depth)
    return triangle, weights, depth


@kernel(error_model="python")
def _rasterise(points: F64, triangles: I32, triangle: I32, weights: F32, nearest: F32) -> None:
    """Fill the nearest front-facing triangle of each pixel; x right, y down, z away."""
    h, w = triangle.shape
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


def remove_specks(drawn: Bool) -> Bool:
    """(h, w) pixels that are drawn, without the connected components that are a small share of them."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(drawn.astype(np.uint8))
    large = stats[:, cv2.CC_STAT_AREA] >= SPECK * drawn.sum()
    return np.asarray(drawn & large[labels])


def _outlines(instance: I32, depth: F32) -> F64:
    """(h, w) 1 where a plane, or what stands before something else, ends."""
    behind = np.where(np.isfinite(depth), depth, 2.0)
    edge = np.zeros(depth.shape)
    for axis in (0, 1):
        near, far = (np.take(behind, range(k, behind.shape[axis] - 1 + k), axis) for k in (0, 1))
        one, other = (np.take(instance, range(k, behind.shape[axis] - 1 + k), axis) for k in (0, 1))
        found = (np.abs(near - far) > EDGE_STEP) | ((one != other) & (one >= 0) & (other >= 0))
        edge[: found.shape[0], : found.shape[1]][found] = 1.0
    return edge


def _merge_coplanar(surface: Surface) -> I32:
    """(p + 1,) row of the largest plane that each continues, of those before the last, which is no plane."""
    normals, order = surface.coefficients[:, :3], np.argsort(-surface.areas_m2, kind="stable")
    aligned = normals @ normals.T > np.cos(np.radians(COPLANAR_DEG))
    largest = np.append(np.arange(len(order), dtype=np.int32), np.int32(-1))
    for rank, small in enumerate(order):
        points = surface.vertices_m[np.unique(surface.triangles[surface.instances == small])]
        for large in order[:rank]:
            if aligned[small, large] and np.median(np.abs(points @ normals[large] + surface.coefficients[large, 3])) < COPLANAR_M:
                largest[small] = largest[large]
                break
    return largest


def _tints(surface: Surface, instance: I32) -> F64:
    """(h, w, 3) RGB for rows of planes (h, w): planes in colours of the palette, of which those that touch share none as long as there are enough."""
    count = len(surface.plane_ids)
    near = np.zeros((count + 1, count + 1), bool)  # the last is no plane
    for one, other in ((instance[:, :-1], instance[:, 1:]), (instance[:-1], instance[1:])):
        near[one, other] = near[other, one] = True
    chosen, used = np.full(count + 1, -1), np.zeros(len(PALETTE), int)
    seen = np.unique(instance[instance >= 0])
    for plane in seen[np.argsort(-surface.areas_m2[seen], kind="stable")]:
        around = np.bincount(chosen[:count][near[plane, :count] & (chosen[:count] >= 0)], minlength=len(PALETTE))
        chosen[plane] = int(np.lexsort((used, around))[0])  # of those least around, the least used
        used[chosen[plane]] += 1
    return np.concatenate([PALETTE[chosen[:count]], [REST]])[instance]


def _brighten_colors(color: F64) -> F64:
    """Lift the colours of a dark room: the square root of their share of the brightest."""
    bright = max(float(np.percentile(color[color.any(axis=-1)], 99)), 1.0) if color.any() else 1.0
    return np.asarray(BRIGHT * np.clip(color / bright, 0.0, 1.1) ** 0.6)


def _colors(surface: Surface, triangle: I32, weights: F32) -> F64:
    """(h, w, 3) RGB: of the atlas where there is a picture of the plane, else between the vertices."""
    out = np.einsum("hwk,hwkc->hwc", weights, surface.colors[surface.triangles[triangle]].astype(np.float32))
    place = np.einsum("hwk,hwkc->hwc", weights, surface.texels[triangle])
    pictured = (triangle >= 0) & np.isfinite(place[..., 0])
    x, y = np.rint(np.nan_to_num(place)).astype(int).transpose(2, 0, 1)
    atlas: U8 = surface.atlas
    out[pictured] = atlas[np.clip(y, 0, max(len(atlas) - 1, 0)), np.clip(x, 0, max(atlas.shape[1] - 1, 0))][pictured] if atlas.size else 0.0
    out[triangle < 0] = 0.0
    return np.asarray(out, np.float64)


FORMATS = (Format("png", "surface.png", write_planes_picture, {"images": Format("png", "surface.png", write_images_picture)}),)
