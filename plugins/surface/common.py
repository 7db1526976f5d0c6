"""Functions of all surfaces: views are retained, fused as they come, and coloured meshes made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveShare, Range
from trihedron.pipeline.core.types import F32, F64, I32, LOST, PLANE_KINDS, U8, Bool, DepthNoise, Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.shared.keyframe_views import KeyframeView, Known, readings, view_of
from trihedron.plugins.surface.common_kernels import off_planes, paint
from trihedron.plugins.surface.common_meshes import compacted, plane_axes, triangle_areas, vertex_normals

NOVELTY_COLUMNS = 80  # of readings that are tested for novelty
CELL_M = 0.1  # of what is remembered to be known


@dataclass
class Gathered:
    """The state of a surface: the views kept, what they know of each sub-map's world, and the last frame."""

    views: list[KeyframeView] = field(default_factory=list)
    known: dict[int, Known] = field(default_factory=dict)
    surfels: list[F64] = field(default_factory=list)  # each view's own
    axes: F64 | None = None  # R_world_manhattan
    index: int = 0
    stamp_ns: int = 0

    def settled(self, map: Map | None) -> list[tuple[KeyframeView, F64]]:
        """The views that stand in the first frame's world in the end, with their final poses `T_world_camera`."""
        return [(view, T) for view in self.views if (T := view.settled(map)) is not None]

    def up(self, views: Sequence[tuple[KeyframeView, F64]]) -> F64:
        """(3,) the Manhattan axis nearest to the mean of the views' upward directions; NaN without axes or views."""
        if self.axes is None or not views:
            return np.full(3, np.nan)
        upright = -np.mean([T[:3, 1] for _, T in views], axis=0)
        along = matmul(self.axes.T, upright)
        best = int(np.argmax(np.abs(along)))
        return np.asarray(self.axes[:, best] * np.sign(along[best]), np.float64)


@dataclass(frozen=True)
class ViewOptions:
    """Options by which a surface retains views."""

    view_width: Annotated[int, Range(16, 4096)] = 320  # px, about, to which images are reduced
    max_sigma_m: PositiveFloat = 0.05  # depth less certain than this is not used: a Kinect's beyond 4.2 m; a frame's planes say how certain it is
    views: Annotated[float, Range(1)] = 6.0  # of its quality, after which a view has nothing new to tell of a place
    news: PositiveShare = 0.15  # share of new readings for which a view is kept


def add_view(
    options: ViewOptions, state: Gathered, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None
) -> KeyframeView | None:  # fmt: skip
    """Retain the frame in the state and return its view, if it was tracked and shows something new; else return None."""
    state.index, state.stamp_ns = frame.index, frame.stamp_ns
    if rotation is not None and len(rotation.weights):
        state.axes = rotation.R_world_manhattan[int(np.argmax(rotation.weights))]
    if pose.status == LOST:
        return None
    frame = with_measured_noise(frame, planes)
    points, weight = readings(frame, pose.T_world_camera, max(1, frame.camera.width // NOVELTY_COLUMNS), options.max_sigma_m)
    known = state.known.setdefault(pose.submap, Known(CELL_M))
    if not len(points) or known.novelty(points, weight, options.views) < options.news:
        return None
    known.learn(points, weight)
    view = view_of(frame, planes, pose, map, options.view_width, options.max_sigma_m)
    state.views.append(view)
    return view


# How noisy a depth image is, by its own planes: a data set does not always say what made it.

COLUMNS = 160  # of readings that are asked
LEAST = 500  # of them on planes, below which the camera's model is believed
MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution whose median distance from 0 is 1


def with_measured_noise(frame: Frame, planes: Planes) -> Frame:
    """The frame with its camera's depth noise scaled to what half of the readings on planes show of it; never above the camera's own, and never below
    its floor."""
    camera, noise = frame.camera, frame.camera.depth_noise
    intrinsics = camera.intrinsics
    step = max(1, planes.labels.shape[1] // COLUMNS)
    off, depth = off_planes(frame.depth_m, planes.labels, planes.coefficients, planes.stride, step, intrinsics)
    if len(off) < LEAST:
        return frame
    scale = float(min(1.0, MAD_TO_SIGMA * np.median(off / noise.sigma_m(depth))))
    return replace(frame, camera=replace(camera, depth_noise=DepthNoise(scale * noise.a_m, scale * noise.b, scale * noise.c_per_m, noise.floor_m)))


# Meshes as values of the topic `surface`: coloured, with the facts about their planes.

LEVEL_DEG = 20.0  # a plane that leans by less is level, or upright
SAME_LEVEL_M, WIDE_M2, HIGH_M = 0.15, 0.5, 1.0  # floor and ceiling: this near to the lowest or highest wide one; a wall is wide and this high


def coloured(state: Gathered, map: Map | None, vertices: F64, triangles: I32) -> Surface:
    """A surface of triangles (t, 3) that belong to no plane."""
    views = state.settled(map)
    vertices, triangles, _ = compacted(vertices, triangles)
    colors = spread(vertices, *painted(vertices, vertex_normals(vertices, triangles), views))
    return replace(
        Surface.empty(state.index, state.stamp_ns),
        vertices_m=vertices.astype(np.float32),
        colors=colors,
        triangles=triangles,
        instances=np.full(len(triangles), -1, np.int32),
        texels=np.full((len(triangles), 3, 2), np.nan, np.float32),
        up=state.up(views),
    )


def pictured(
    state: Gathered, map: Map | None, vertices: F64, triangles: I32, labels: I32, planes: F64, ids: I32, loops: Sequence[tuple[int, I32]],
    texel_m: float,
) -> Surface:  # fmt: skip
    """A surface whose triangles (t, 3) lie in planes (p, 4) with ids (p,), or in none: `labels` (t,). Planes without a triangle are left out."""
    plain = coloured(state, map, vertices, triangles)
    _, _, renamed = compacted(vertices, triangles)
    used, rows = np.unique(labels, return_inverse=True)
    rows, used = (rows - 1, used[1:]) if len(used) and used[0] < 0 else (rows, used)
    planes, points = planes[used], plain.vertices_m.astype(np.float64)
    atlas = atlas_of(points, plain.triangles, rows, planes, state.settled(map), texel_m)
    rings = [(int(np.searchsorted(used, plane)), renamed[ring]) for plane, ring in loops]
    ends = np.cumsum([0, *(len(ring) for _, ring in rings)])
    areas = np.bincount(rows + 1, triangle_areas(points, plain.triangles), len(used) + 1)[1:].astype(np.float32)
    return replace(
        plain,
        instances=rows.astype(np.int32),
        plane_ids=ids[used],
        coefficients=planes,
        kinds=_kinds(planes, areas, matmul(points[plain.triangles], plain.up), rows, plain.up),
        areas_m2=areas,
        plane_colors=atlas.colors,
        loops=np.array([(plane, a, b) for (plane, _), a, b in zip(rings, ends[:-1], ends[1:])], np.int32).reshape(-1, 3),
        loop_vertices=np.concatenate([np.empty(0, np.int32), *(ring for _, ring in rings)]).astype(np.int32),
        atlas=atlas.image,
        texels=atlas.texels,
    )


def map_planes(map: Map | None) -> tuple[I32, F64]:
    """Ids (n,) and coefficients (n, 4) of the living planes."""
    if map is None:
        return np.empty(0, np.int32), np.empty((0, 4))
    ids = np.flatnonzero(map.planes.column("alive")).astype(np.int32)
    return ids, map.planes.rows("coefficients", ids)


def numbered(ids: I32, count: int, map: Map | None) -> I32:
    """Ids for `count` planes: the map's, then numbers that it has not given for those that are not in it."""
    first = len(map.planes) if map is not None else 0
    return np.concatenate([ids, np.arange(first, first + count - len(ids))]).astype(np.int32)


def _heights(corners: F64, rows: I32, count: int) -> F64:
    """(p, 2) lowest and highest place of each plane, by the heights (t, 3) of its triangles' corners."""
    out = np.tile([np.inf, -np.inf], (count, 1))
    planar = rows >= 0
    np.minimum.at(out[:, 0], rows[planar], corners[planar].min(axis=1))
    np.maximum.at(out[:, 1], rows[planar], corners[planar].max(axis=1))
    return out


def _kinds(planes: F64, areas: F32, corners: F64, rows: NDArray[np.signedinteger], up: F64) -> U8:
    """(p,) rows of PLANE_KINDS; the most general one for all when nobody knows which way is up."""
    kinds = np.full(len(planes), PLANE_KINDS.index("plane"), np.uint8)
    if not np.isfinite(up).all():
        return kinds
    leaning, heights = matmul(planes[:, :3], up), _heights(corners, rows, len(planes))
    level, upright = np.cos(np.radians(LEVEL_DEG)), np.sin(np.radians(LEVEL_DEG))
    kinds[np.abs(leaning) > level] = PLANE_KINDS.index("horizontal")
    kinds[np.abs(leaning) < upright] = PLANE_KINDS.index("vertical")
    wide, middle = areas >= WIDE_M2, heights.mean(axis=1)
    kinds[(np.abs(leaning) < upright) & wide & (heights[:, 1] - heights[:, 0] >= HIGH_M)] = PLANE_KINDS.index("wall")
    for name, facing, end in (("floor", leaning > level, 1.0), ("ceiling", leaning < -level, -1.0)):
        if (facing & wide).any():
            last = (end * middle[facing & wide]).min()
            kinds[facing & (end * middle <= last + SAME_LEVEL_M)] = PLANE_KINDS.index(name)
    return kinds


# The colour of points of a surface, from the views that see them.

NEAR_M, VISIBLE_SIGMAS = 0.03, 3.0  # a point is seen where the depth read differs by no more than NEAR_M and SIGMAS standard deviations from its own
UNSEEN = 128
MOST = 48  # views; what one sees its neighbours see too


def painted(points: F64, normals: F64, views: Sequence[tuple[KeyframeView, F64]]) -> tuple[U8, Bool]:
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


def spread(points: F64, colors: U8, seen: Bool) -> U8:
    """The colours (n, 3), those of points that are not seen (the image ends before their mesh does) from the nearest that is."""
    from scipy.spatial import cKDTree

    if seen.all() or not seen.any():
        return colors
    out = colors.copy()
    out[~seen] = colors[seen][cKDTree(points[seen]).query(points[~seen])[1]]
    return out


# One picture for all planes of a surface: each plane's rectangle, seen from its front, in rows on a page.

MARGIN = 1  # texels about each rectangle, so that none bleeds into its neighbour
NARROWEST = 256  # texels of a page


@dataclass(frozen=True)
class Atlas:
    """(h, w, 3) RGB, (t, 3, 2) texels (x, y) of the corners of triangles, NaN for those of no plane, and the (p, 3) mean colours of the planes."""

    image: U8
    texels: F32
    colors: U8


def atlas_of(
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
    places, (width, height) = _packed(np.array(sizes, int).reshape(-1, 2))
    image, colors = np.zeros((height, width, 3), np.uint8), np.zeros((len(planes), 3), np.uint8)
    for p, (plane, basis) in enumerate(zip(planes, axes)):
        (w, h), (x, y) = sizes[p], places[p]
        if w == 0:
            continue
        covered = _covered(texels[labels == p], w, h)
        grid = np.stack(np.nonzero(covered)[::-1], axis=1) + corners[p]
        points = matmul(grid * texel_m, basis.T) - plane[3] * plane[:3]
        found, seen = painted(points, np.broadcast_to(plane[:3], points.shape), views)
        picture, known = np.full((h, w, 3), UNSEEN, np.uint8), np.zeros((h, w), np.bool_)
        picture[covered], known[covered] = found, seen
        image[y : y + h, x : x + w] = _spread(picture, known)
        colors[p] = np.rint(found[seen].mean(axis=0)) if seen.any() else UNSEEN
        texels[labels == p] += np.array([x, y], np.float32)
    return Atlas(image, texels, colors)


def _covered(triangles: F32, w: int, h: int) -> Bool:
    """(h, w) the texels under triangles (t, 3, 2), and those beside them."""
    mask = np.zeros((h, w), np.uint8)
    for corners in np.rint(triangles).astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 1)
    return np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0, np.bool_)


def _spread(picture: U8, seen: Bool) -> U8:
    """(h, w, 3) with the colour of the nearest texel seen where none is: triangles reach a little beyond what the views show."""
    from scipy.ndimage import distance_transform_edt

    if seen.all() or not seen.any():
        return picture
    rows, columns = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    return np.asarray(picture[rows, columns])


def _packed(sizes: I32) -> tuple[I32, tuple[int, int]]:
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
