"""Rooms, walls and openings from faces and free space.

The lines of all faces divide the plan into cells; a solver decides which cells are inside. Inside cells are one room where no tall face parts them
(Mura, Mattausch, Jaspe Villanueva, Gobbetti, Pajarola, Computers & Graphics 2014, with free space in the place of scan positions). Every edge of a
room is then fitted again to the points of its own stretch, so that drift between rooms stays between them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.linalg import det, matmul, norm, solve
from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.types import ELEMENTS, F64, I32, OPENING_KINDS, SUPPORTS, Bool, Building, Map
from trihedron.plugins.building.common import (
    CELL_M,
    LEVEL_DEG,
    LEVEL_M,
    LEVEL_NEAR_M,
    SCALE,
    Evidence,
    Face,
    FreeSpace,
    Gathered,
    LayoutOptions,
    Storey,
    at_level,
    combined,
    drift_variance,
    evidence_of,
    faces_of,
    free_space,
    nothing,
    slanted_directions,
    smoothed,
    storeys_of,
    tall_m,
)
from trihedron.plugins.building.common_kernels import (
    LEVELS,  # fmt: skip
    U32,
)
from trihedron.plugins.shared.voxel_hash_kernels import I64

MARGIN_M = 0.3  # about what was seen
FREE_SHARE = 0.5  # of a cell, for which it may be inside
TALL_SHARE = 0.5  # of an edge between cells, for which it parts them
ON_WALL_SHARE = 0.3  # of a room's edge, for which it is a wall
SAME_LINE_M = 0.02
GLIMPSE_SHARE = 0.1  # the same where the wall was seen from behind
THICKEST_M, THINNEST_M = 0.5, 0.03
FIT_M = 0.04  # about an edge, within which points take part in its fit
PREVIEW_VIEWS = 60
WINDOW_M = 0.35  # least height of a window's sill


@dataclass(frozen=True)
class Cells:
    """The cells of an arrangement: polygons, the share of each that is free, whether any of it was seen, and the edges (a, b, tall share, length)
    between neighbours."""

    polygons: list[Any]
    free: F64
    edges: list[tuple[int, int, float, float]]


@dataclass
class Edge:
    """An edge of a room on the line n·p = offset, n into the room; `face` is None where nothing bounds what was seen."""

    normal: F64
    offset_m: float
    face: Face | None
    begin: F64 = field(default_factory=lambda: np.zeros(2))
    end: F64 = field(default_factory=lambda: np.zeros(2))
    sigma_m: float = float("nan")  # of the offset, relative to the other edges of the room
    drift_m2: float = 0.0  # what the drift of the poses adds to its variance
    angle_sigma: float = float("nan")
    views: I32 = field(default_factory=lambda: np.empty(0, np.int32))
    wall: int = -1

    @property
    def along(self) -> F64:
        """Return the unit direction (2,) that has the room on its left."""
        return np.array([self.normal[1], -self.normal[0]])

    @property
    def span(self) -> tuple[float, float]:
        """Return begin and end along `along`."""
        a, b = float(matmul(self.begin, self.along)), float(matmul(self.end, self.along))
        return min(a, b), max(a, b)


@dataclass
class RoomPlan:
    """A room: its loops of edges, the outer one first."""

    loops: list[list[Edge]]
    polygon: Any


def cells_of(faces: list[Face], space: FreeSpace) -> Cells:
    """Cut the plan along the lines of all faces, and ask free space of each cell and the faces of each edge between two."""
    import shapely
    from shapely.ops import polygonize, unary_union

    h, w = space.levels.shape
    low, high = space.origin, space.origin + CELL_M * np.array([w, h])
    box = shapely.box(*low, *high)
    reach = float(norm(high - low))
    middle = (low + high) / 2.0
    lines = [box.exterior]
    for face in faces:
        foot = middle + (face.offset_m - matmul(middle, face.normal)) * face.normal
        lines.append(shapely.LineString([foot - reach * face.along, foot + reach * face.along]).intersection(box))
    polygons = list(polygonize(unary_union(shapely.set_precision(lines, 1e-5))))
    free = np.array([_free_share(polygon, space) for polygon in polygons])
    sides: dict[tuple[tuple[float, float], tuple[float, float]], list[int]] = defaultdict(list)
    for number, polygon in enumerate(polygons):
        ring = [tuple(np.round(p, 4)) for p in polygon.exterior.coords]
        for p, q in pairwise(ring):
            if p != q:
                sides[min(p, q), max(p, q)].append(number)
    edges = []
    for (p, q), pair in sides.items():
        if len(pair) == 2:
            a, b = np.array(p), np.array(q)
            edges.append((pair[0], pair[1], _tall_share(faces, a, b), float(norm(b - a))))
    return Cells(polygons, free, edges)


def _free_share(polygon: Any, space: FreeSpace) -> float:
    """Return the share of a cell that rays passed."""
    import shapely

    x0, y0, x1, y1 = polygon.bounds
    grid = np.stack(np.meshgrid(_steps(x0, x1), _steps(y0, y1)), axis=-1).reshape(-1, 2)
    inside = grid[shapely.contains_xy(polygon, grid[:, 0], grid[:, 1])]
    if len(inside) == 0:
        inside = np.array([polygon.representative_point().coords[0]])
    return float((space.at(inside) != 0).mean())


def _steps(low: float, high: float) -> F64:
    count = max(int((high - low) / CELL_M), 2)
    return low + (np.arange(count) + 0.5) * (high - low) / count


def _tall_share(faces: list[Face], a: F64, b: F64) -> float:
    """Return the greatest share of a stretch that one face covers with tall columns."""
    direction = (b - a) / max(float(norm(b - a)), 1e-9)
    best = 0.0
    for face in faces:
        if abs(float(matmul(direction, face.normal))) < 0.02 and abs(float(matmul(a + b, face.normal)) / 2.0 - face.offset_m) < 0.02:
            t0, t1 = sorted((float(matmul(a, face.along)), float(matmul(b, face.along))))
            best = max(best, face.share(t0, t1, face.tall))
    return best


def components(cells: Cells, inside: Bool) -> list[I32]:
    """Join inside cells that no tall face parts; the largest first."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    kept = [(a, b) for a, b, tall, _ in cells.edges if inside[a] and inside[b] and tall < TALL_SHARE]
    pairs = np.array(kept, int).reshape(-1, 2)
    n = len(cells.polygons)
    _, labels = connected_components(coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n)), directed=False)
    groups = [np.nonzero((labels == label) & inside)[0].astype(np.int32) for label in np.unique(labels[inside])]
    return sorted(groups, key=lambda group: -sum(cells.polygons[k].area for k in group))


def rooms_of(cells: Cells, inside: Bool, faces: list[Face], evidence: Evidence, space: FreeSpace, storey: Storey, least_m2: float) -> list[RoomPlan]:
    """Make the polygons of rooms of which at least `least_m2` of floor or free space was seen, with their edges fitted."""
    import shapely
    from shapely.ops import unary_union

    found = []
    for group in components(cells, inside):
        whole = shapely.simplify(unary_union([cells.polygons[k] for k in group]), 1e-4)
        for polygon in whole.geoms if whole.geom_type == "MultiPolygon" else [whole]:
            polygon = _opened(polygon)
            if polygon is None or polygon.area < least_m2 or not _stood_on(polygon, evidence, space):
                continue
            polygon = shapely.geometry.polygon.orient(polygon)
            rings = (polygon.exterior, *polygon.interiors)
            loops = [_edges(ring, faces) for ring in rings]
            for edge in (edge for loop in loops for edge in loop):
                _fit(edge, evidence, storey)
            loops = [_ended(loop, faces) for loop in loops]
            for loop in loops:
                _cornered(loop)
            _relative([edge for loop in loops for edge in loop])
            found.append(RoomPlan(loops, polygon))
    return found


def _relative(edges: list[Edge]) -> None:
    """Add to the edges of a room the drift that they do not have in common, and what the scale may move them from its middle."""
    middle = np.mean([edge.begin for edge in edges], axis=0)
    common = min((edge.drift_m2 for edge in edges if edge.face is not None), default=0.0)
    for edge in edges:
        size = SCALE * (edge.offset_m - matmul(middle, edge.normal))
        edge.sigma_m = float(np.sqrt(edge.sigma_m**2 + size**2 + max(edge.drift_m2 - common, 0.0)))
        edge.drift_m2 = common


SLIT_M = 0.03  # half of the width of what is no part of a room


def _opened(polygon: Any) -> Any:
    """Return the polygon without slits narrower than twice SLIT_M, or None."""
    slim = polygon.buffer(-SLIT_M, join_style="mitre").buffer(SLIT_M, join_style="mitre")
    if slim.geom_type == "MultiPolygon":
        slim = max(slim.geoms, key=lambda part: part.area)
    slim = slim.simplify(1e-3)
    return None if slim.is_empty else slim


def _stood_on(polygon: Any, evidence: Evidence, space: FreeSpace) -> bool:
    """Say if a camera was in it, or some of its floor was seen."""
    import shapely

    eyes = np.array([T[:2, 3] for T in evidence.poses])
    if shapely.contains_xy(polygon, eyes[:, 0], eyes[:, 1]).any():
        return True
    row, column = np.nonzero(space.floor)
    cells = space.origin + (np.stack([column, row], axis=1) + 0.5) * CELL_M
    return float(shapely.contains_xy(polygon, cells[:, 0], cells[:, 1]).sum()) * CELL_M**2 >= 0.5


def _edges(ring: Any, faces: list[Face]) -> list[Edge]:
    """Return the edges of a ring that has the room on its left, each on the face that covers it."""
    points = np.array(ring.coords)[:-1]
    out = []
    for p, q in zip(points, np.roll(points, -1, axis=0)):
        length = float(norm(q - p))
        along = (q - p) / length
        normal = np.array([-along[1], along[0]])
        best, share = None, 0.0
        for face in faces:
            if float(matmul(face.normal, normal)) > 0.999 and abs(float(matmul(p + q, face.normal)) / 2.0 - face.offset_m) < SAME_LINE_M:
                covered = face.share(float(matmul(p, face.along)), float(matmul(q, face.along)), face.count.sum(axis=1) > 0)
                if covered > share:
                    best, share = face, covered
        glimpsed = share >= GLIMPSE_SHARE and _backed(normal, float(matmul(p, normal)), p, q, faces)
        on = best if share >= ON_WALL_SHARE or glimpsed else None
        out.append(Edge(on.normal if on is not None else normal, float(matmul(p, normal)) if on is None else on.offset_m, on, p, q))
    return out


def _backed(normal: F64, offset_m: float, p: F64, q: F64, faces: list[Face]) -> bool:
    """Say if the other face of a wall, which was seen from behind, covers most of a stretch from p to q of a line."""
    return any(
        float(matmul(other.normal, normal)) < -0.999
        and -SAME_LINE_M < offset_m + other.offset_m < THICKEST_M
        and other.share(float(matmul(q, other.along)), float(matmul(p, other.along)), other.tall) > TALL_SHARE
        for other in faces
    )


def _near(edge: Edge, face: Face, evidence: Evidence, within_m: float, end_m: float) -> I64:
    """Return the numbers (n,) of the points of a face that lie on an edge."""
    a, b = edge.span
    points = evidence.points[face.members, :2]
    t, off = matmul(points, edge.along), matmul(points, edge.normal) - edge.offset_m
    return np.asarray(face.members[(np.abs(off) < within_m) & (t > a + end_m) & (t < b - end_m)])


LEAST_POINTS = 100


def _fit(edge: Edge, evidence: Evidence, storey: Storey) -> None:
    """Fit the edge's offset to the points of its own stretch, those above doors and pictures if there are enough."""
    if edge.face is None:
        return
    for within in (FIT_M, FIT_M):
        mask = _near(edge, edge.face, evidence, within, min(0.1, (edge.span[1] - edge.span[0]) / 4.0))
        high = mask[evidence.points[mask, 2] - storey.bottom_m > tall_m(storey)]
        mask = high if len(high) >= LEAST_POINTS else mask
        if len(mask) == 0:
            return
        rows = evidence.rows[mask]
        offset, sigma = combined(matmul(evidence.points[mask, :2], edge.normal), evidence.information[mask], rows)
        edge.offset_m, edge.sigma_m, edge.views = offset, sigma, np.unique(rows)
        edge.drift_m2 = drift_variance(evidence, np.array([*edge.normal, 0.0]), evidence.information[mask], rows)
        t = matmul(evidence.points[mask, :2], edge.along)
        if np.abs(edge.normal).max() < AXIS:
            _turn(edge, evidence.points[mask, :2], evidence.information[mask])
        edge.angle_sigma = float(np.hypot(sigma / max(float(t.std()) * 2.0, 0.1), np.radians(0.03)))


AXIS = 1.0 - 1e-9  # greatest component of a normal along an axis of the building


def _turn(edge: Edge, points: F64, information: F64) -> None:
    """Turn an edge that is along no axis of the building to its own points (n, 2)."""
    t, off = matmul(points, edge.along), matmul(points, edge.normal) - edge.offset_m
    middle = float(np.average(t, weights=information))
    spread = float(matmul(information, (t - middle) ** 2))
    slope = float(matmul(information, (t - middle) * off)) / spread if spread > 0.0 else 0.0
    centre = middle * edge.along + edge.offset_m * edge.normal
    normal = edge.normal - slope * edge.along
    edge.normal = normal / norm(normal)
    edge.offset_m = float(matmul(centre, edge.normal))


LEAST_OPEN_M = 0.15  # of an edge beyond the last reading


def _ended(loop: list[Edge], faces: list[Face]) -> list[Edge]:
    """Let edges on a face end where its readings do, if nothing bounds the room beyond; the rest is an edge that nothing bounds either."""
    out: list[Edge] = []
    for before, edge, after in zip([loop[-1], *loop[:-1]], loop, [*loop[1:], loop[0]]):
        pieces = [edge]
        a, b = float(matmul(edge.begin, edge.along)), float(matmul(edge.end, edge.along))
        for open_end, neighbour in ((False, before), (True, after)):
            if edge.face is None or _bounded(neighbour, faces) or (seen := _readings_of(edge.face, a, b)) is None:
                continue
            at = seen[1] if open_end else seen[0]
            if abs((b if open_end else a) - at) > LEAST_OPEN_M:
                corner = at * edge.along + edge.offset_m * edge.normal
                if open_end:
                    pieces.append(Edge(edge.normal, edge.offset_m, None, corner, edge.end))
                    edge.end = corner
                else:
                    pieces.insert(0, Edge(edge.normal, edge.offset_m, None, edge.begin, corner))
                    edge.begin = corner
        out += pieces
    return out


def _bounded(edge: Edge, faces: list[Face]) -> bool:
    """Say if there is a wall at an edge, seen from either side."""
    return edge.face is not None or _backed(edge.normal, edge.offset_m, edge.begin, edge.end, faces)


def _readings_of(face: Face, a: float, b: float) -> tuple[float, float] | None:
    """Return where along a face its readings between two places begin and end, or None without any."""
    starts = face.start_m + CELL_M * np.nonzero(face.count.any(axis=1))[0]
    inside = starts[(starts + CELL_M > a) & (starts < b)]
    return (max(float(inside[0]), a), min(float(inside[-1]) + CELL_M, b)) if len(inside) else None


def _cornered(loop: list[Edge]) -> None:
    """Put the corners of a ring where its edges' lines meet."""
    for before, edge in zip([loop[-1], *loop[:-1]], loop):
        A = np.stack([before.normal, edge.normal])
        if abs(det(A)) > 0.05:
            corner = np.asarray(solve(A, [before.offset_m, edge.offset_m]), np.float64)
        else:
            corner = edge.begin + (edge.offset_m - matmul(edge.begin, edge.normal)) * edge.normal
        before.end, edge.begin = corner, corner


# Walls: the edges of rooms that lie on one face or back to back.


@dataclass
class WallPlan:
    """A wall: its face n·p = offset from `begin` to `end` along it, and what is behind it."""

    edge: Edge
    span: tuple[float, float]
    thickness_m: float
    thickness_sigma_m: float
    edges: list[tuple[int, Edge]]


def walls_of(rooms: list[RoomPlan], faces: list[Face], evidence: Evidence, storey: Storey, least_m: float) -> list[WallPlan]:
    """Group the edges of rooms into walls, numbering them in the edges; then the tall stretches of at least `least_m` that bound no room."""
    edges = [(number, edge) for number, room in enumerate(rooms) for loop in room.loops for edge in loop if edge.face is not None]
    group = list(range(len(edges)))

    def root(k: int) -> int:
        while group[k] != k:
            k = group[k]
        return k

    for i, (_, first) in enumerate(edges):
        for j in range(i):
            if _one_wall(first, edges[j][1]):
                group[root(i)] = root(j)
    found: list[WallPlan] = []
    for number in sorted({root(k) for k in range(len(edges))}):
        members = [edges[k] for k in range(len(edges)) if root(k) == number]
        found.append(_wall(members, faces, len(found)))
    stretches = [(face, a, b) for face in faces for a, b in _stretches(face, least_m)]
    for face, a, b in sorted(stretches, key=lambda item: item[1] - item[2]):
        foot = face.offset_m * face.normal
        edge = Edge(face.normal, face.offset_m, face, foot + a * face.along, foot + b * face.along)
        if any(_beside(edge, wall) for wall in found):
            continue
        _fit(edge, evidence, storey)
        wall = _wall([(-1, edge)], faces, len(found))
        if np.isfinite(wall.thickness_m) or not _within_room(edge, rooms):
            found.append(wall)
    return found


def _within_room(edge: Edge, rooms: list[RoomPlan]) -> bool:
    """Say if a room is on both sides of an edge, as it is of furniture of which no ray got behind."""
    middle = (edge.begin + edge.end) / 2.0
    before, behind = (_room_at(rooms, middle + side * AROUND_M / 2.0 * edge.normal) for side in (1.0, -1.0))
    return before >= 0 and before == behind


def _stretches(face: Face, least_m: float) -> list[tuple[float, float]]:
    """Return begin and end along a face of its tall stretches of at least a length."""
    ends = np.nonzero(np.diff(np.concatenate([[False], face.tall, [False]])))[0]
    return [(float(a), float(b)) for a, b in face.start_m + CELL_M * ends.reshape(-1, 2) if b - a >= least_m - 1e-9]


def _beside(edge: Edge, wall: WallPlan) -> bool:
    """Say if an edge is one of a wall's faces, or so near to one that the readings may be furniture before it or stray ones behind it."""
    facing = float(matmul(edge.normal, wall.edge.normal))
    (a, b), (c, d) = edge.span, wall.span if facing > 0.0 else (-wall.span[1], -wall.span[0])
    away = edge.offset_m - np.sign(facing) * wall.edge.offset_m
    return abs(facing) > 0.99 and abs(away) < THICKEST_M and min(b, d) - max(a, c) > 0.0


def _one_wall(a: Edge, b: Edge) -> bool:
    """Say if two edges are the two sides of one wall, or stretches of one side with less than a wall's thickness between them."""
    turned = float(matmul(a.normal, b.normal))
    (a0, a1), (b0, b1) = a.span, b.span
    if turned < 0.0:
        b0, b1 = -b1, -b0
    overlap = min(a1, b1) - max(a0, b0)
    if turned > 0.999:
        return abs(a.offset_m - b.offset_m) < 0.05 and overlap > -THICKEST_M
    behind = a.offset_m + b.offset_m  # of a's face, where b's is
    return turned < -0.999 and THINNEST_M / 2.0 < behind < THICKEST_M and overlap > 0.2


def _wall(members: list[tuple[int, Edge]], faces: list[Face], number: int) -> WallPlan:
    """Make the wall of some edges, its face that of the longest."""
    for _, edge in members:
        edge.wall = number
    main = max((edge for _, edge in members), key=lambda edge: edge.span[1] - edge.span[0])
    spans = [edge.span if matmul(edge.normal, main.normal) > 0 else (-edge.span[1], -edge.span[0]) for _, edge in members]
    span = min(a for a, _ in spans), max(b for _, b in spans)
    behind = [edge for _, edge in members if matmul(edge.normal, main.normal) < 0]
    if behind:
        other = max(behind, key=lambda edge: edge.span[1] - edge.span[0])
        sigma = float(np.sqrt(main.sigma_m**2 + other.sigma_m**2 + abs(main.drift_m2 - other.drift_m2)))
        return WallPlan(main, span, main.offset_m + other.offset_m, sigma, members)
    for face in faces:  # seen through a door, but no room's
        depth = main.offset_m + face.offset_m
        if (
            matmul(face.normal, main.normal) < -0.999
            and THINNEST_M / 2.0 < depth < THICKEST_M
            and face.share(-span[1], -span[0], face.tall) > TALL_SHARE
        ):
            return WallPlan(main, span, depth, float(np.hypot(main.sigma_m, 0.005)), members)
    return WallPlan(main, span, float("nan"), float("nan"), members)


# Openings: where rays cross a wall.


@dataclass
class OpeningPlan:
    """An opening of wall number `wall`: stretch and heights with their standard deviations, kind, rooms on both sides."""

    wall: int
    span: tuple[float, float]
    heights: tuple[float, float]
    sigmas: tuple[float, float, float, float]
    kind: str
    rooms: tuple[int, int]
    views: I32


def openings_of(
    walls: list[WallPlan], rooms: list[RoomPlan], faces: list[Face], evidence: Evidence, space: FreeSpace, storey: Storey
) -> list[OpeningPlan]:
    """Find the stretches of each wall that rays cross from well before it to well behind it, at the same heights."""
    found = []
    for number, wall in enumerate(walls):
        levels = _crossed(wall, space)
        crossed = np.array([bin(int(value)).count("1") >= 3 for value in levels], bool)
        marked = np.nonzero(_bridged(crossed))[0]
        for run in np.split(marked, np.nonzero(np.diff(marked) > 1)[0] + 1) if len(marked) else []:
            opening = _opening(number, wall, run, levels, evidence, storey, rooms, faces)
            if opening is not None:
                found.append(opening)
    return found


def _bridged(columns: Bool) -> Bool:
    """Close gaps of one column."""
    return np.asarray(columns | (np.roll(columns, 1) & np.roll(columns, -1)), np.bool_)


STEP_M = 0.025
BEHIND_M = 0.1  # a ray that gets so far behind a wall has crossed it


def _crossed(wall: WallPlan, space: FreeSpace) -> U32:
    """Return the levels (n,) that rays pass on both sides of the wall and within it, at steps of STEP_M from its start."""
    a, b = wall.span
    t = a + STEP_M / 2.0 + STEP_M * np.arange(max(int((b - a) / STEP_M), 0))
    edge, depth = wall.edge, wall.thickness_m if np.isfinite(wall.thickness_m) else 0.0
    line = t[:, None] * edge.along + edge.offset_m * edge.normal
    out = space.at(line + 0.1 * edge.normal)
    behind = BEHIND_M if np.isfinite(wall.thickness_m) else 2.0 * BEHIND_M
    for back in (*np.linspace(0.0, depth, 1 + int(depth / CELL_M)), depth + behind):
        out = out & space.at(line - back * edge.normal)
    return out


NARROWEST_M, WIDEST_DOOR_M = 0.4, 1.6
AROUND_M = 0.3  # an opening, where the readings of its wall are those of its jambs, lintel and sill
LEAST_LEVELS = 5


def _opening(
    number: int,
    wall: WallPlan,
    run: NDArray[np.signedinteger],
    levels: U32,
    evidence: Evidence,
    storey: Storey,
    rooms: list[RoomPlan],
    faces: list[Face],
) -> OpeningPlan | None:
    """Make the opening of a run of columns, or None when it is too small to be one."""
    a, b = wall.span[0] + STEP_M * run[0], wall.span[0] + STEP_M * (run[-1] + 1)
    share = np.array([np.mean((levels[run] >> np.uint32(level)) & np.uint32(1)) for level in range(LEVELS)])
    open_levels = np.nonzero(share > 0.3)[0]
    if b - a < NARROWEST_M or len(open_levels) < LEAST_LEVELS:
        return None
    *near, rows = _wall_points(wall, faces, evidence, storey)
    gap = _gap(a, b, _between_levels(open_levels, *near))
    if gap is None:
        return None
    a, b, sigma_side, jambs = _jambs(*gap, _between_levels(open_levels, *near))
    if b - a < NARROWEST_M:
        return None
    bottom, top, sigma_top, lintel = _heights(a, b, open_levels, *near)
    ceiling = storey.ceiling_m - storey.bottom_m if np.isfinite(storey.ceiling_m) else float("inf")
    door = (jambs or lintel) and b - a <= WIDEST_DOOR_M and top <= ceiling - 0.1
    kind = "window" if bottom > WINDOW_M else "door" if door else "passage"
    sigmas = (sigma_side, sigma_side, 0.02 if bottom else 0.01, sigma_top)
    middle = (a + b) / 2.0 * wall.edge.along + wall.edge.offset_m * wall.edge.normal
    depth = wall.thickness_m if np.isfinite(wall.thickness_m) else 0.0
    front, *back = (_room_at(rooms, middle + off * wall.edge.normal) for off in (0.1, -depth - 0.1, -depth - 0.2, -depth - 0.35))
    beside = (near[0] > a - AROUND_M) & (near[0] < b + AROUND_M)
    return OpeningPlan(number, (a, b), (bottom, top), sigmas, kind, (front, next((room for room in back if room >= 0), -1)), np.unique(rows[beside]))


def _wall_points(wall: WallPlan, faces: list[Face], evidence: Evidence, storey: Storey) -> tuple[F64, F64, I32]:
    """Return (n,) places along, (n,) heights above the floor and (n,) views of the points on either face of a wall."""
    edge, depth = wall.edge, wall.thickness_m if np.isfinite(wall.thickness_m) else 0.0
    members = [np.empty(0, np.int64)]
    for face in faces:
        turned = float(matmul(face.normal, edge.normal))
        if (turned > 0.999 and abs(face.offset_m - edge.offset_m) < FIT_M) or (
            turned < -0.999 and abs(face.offset_m + edge.offset_m - depth) < FIT_M
        ):
            members.append(face.members)
    chosen = np.concatenate(members)
    points = evidence.points[chosen]
    return matmul(points[:, :2], edge.along), points[:, 2] - storey.bottom_m, evidence.rows[chosen]


def _between_levels(open_levels: NDArray[np.signedinteger], along: F64, height: F64) -> F64:
    """Return the places (k,) along a wall of its readings well between the lowest and the highest level of an opening."""
    low, high = LEVEL_M * (open_levels[0] + 1), LEVEL_M * open_levels[-1]
    return np.asarray(along[(height > max(low, 0.2)) & (height < min(high, 1.9))])


SPARSE = 0.2  # of the readings beside it, fewer than which an opening has: a wall's that lets rays through by their noise is as dense as ever


def _gap(a: float, b: float, readings: F64) -> tuple[float, float] | None:
    """Return begin and end of the widest part of a crossed stretch that has next to no readings of the wall, or None where it is too narrow."""
    count = max(round((b - a) / CELL_M), 1)
    dense = np.histogram(readings, count + 12, (a - 6 * CELL_M, a + (count + 6) * CELL_M))[0]
    usual = float(np.median(dense[dense > 0])) if dense.any() else 0.0
    ends = np.nonzero(np.diff(np.concatenate([[False], dense[6:-6] <= SPARSE * usual, [False]])))[0].reshape(-1, 2)
    if len(ends) == 0:
        return None
    first, stop = ends[np.argmax(ends[:, 1] - ends[:, 0])]
    return (a + CELL_M * float(first), a + CELL_M * float(stop)) if CELL_M * (stop - first) >= NARROWEST_M - CELL_M else None


def _jambs(a: float, b: float, low: F64) -> tuple[float, float, float, bool]:
    """Move the sides of an opening to where the wall's readings (k,) along it end; the standard deviation of the sides, and if both were seen."""
    middle = (a + b) / 2.0
    left = _end_of(middle - low[(low < middle) & (low > a - 0.3)], middle - a)
    right = _end_of(low[(low > middle) & (low < b + 0.3)] - middle, b - middle)
    known = np.isfinite([left, right])
    return middle - left if known[0] else a, middle + right if known[1] else b, 0.015 if known.all() else CELL_M / 2.0, bool(known.all())


END_STEP_M = 0.01


def _end_of(away: F64, guess_m: float) -> float:
    """Return the distance at which readings (n,) become half as dense as they are beyond `guess_m`; NaN when there are too few."""
    if (away > guess_m).sum() < 30:
        return float("nan")
    density = np.bincount((away / END_STEP_M).astype(int), minlength=int(guess_m / END_STEP_M) + 1)
    beyond = density[int((guess_m + CELL_M) / END_STEP_M) :]
    if len(beyond) == 0 or np.median(beyond) == 0.0:
        return float("nan")
    smooth = smoothed(density, np.ones(3) / 3.0)
    dense = np.nonzero(smooth >= 0.5 * np.median(beyond))[0]
    return float(dense[0]) * END_STEP_M if len(dense) else float("nan")


def _heights(a: float, b: float, open_levels: NDArray[np.signedinteger], along: F64, height: F64) -> tuple[float, float, float, bool]:
    """Return bottom and top of an opening above the floor, the top's standard deviation, and if a lintel was seen, which the top is by. What is open
    only higher up is a window if the wall was seen below it."""
    inside = (along > a + 0.1) & (along < b - 0.1)
    bottom, top = float(open_levels[0]) * LEVEL_M, float(open_levels[-1] + 1) * LEVEL_M
    if bottom < WINDOW_M or (height[inside] < bottom - LEVEL_M).sum() < 30:
        bottom = 0.0
    lintel = height[inside & (height > 1.5)]
    if len(lintel) >= 30:
        return bottom, float(np.percentile(lintel, 1.0)), 0.02, True
    return bottom, top, LEVEL_M / 2.0, False


def _room_at(rooms: list[RoomPlan], point: F64) -> int:
    """Return the room that holds a point (2,), -1 for none."""
    import shapely

    return next((k for k, room in enumerate(rooms) if shapely.contains_xy(room.polygon, *point)), -1)


# The plan as a value.


@dataclass
class StoreyPlan:
    """Elements found in one storey."""

    storey: Storey
    rooms: list[RoomPlan]
    walls: list[WallPlan]
    openings: list[OpeningPlan]
    faces: list[Face]
    remark: str = ""


def assembled(state: Gathered, evidence: Evidence, plans: list[StoreyPlan], map: Map | None) -> Building:
    """Put the storeys' elements into one value."""
    support: list[tuple[int, int, int, int]] = []
    walls: list[Any] = []
    corners: list[Any] = []
    edge_sigmas: list[float] = []
    areas: list[float] = []
    thickness, wall_covariance, unseen, wall_storeys = [], [], [], []
    loops, corner_walls, variances, closed, room_storeys = [], [], [], [], []
    spans: list[list[float]] = []
    heights, kinds, opening_walls, opening_covariance, opening_rooms = [], [], [], [], []
    used: set[int] = set()
    for level, plan in enumerate(plans):
        first_wall, first_room = len(walls), len(areas)
        support += _supports("storey", level, *_level_support(plan.storey, evidence, map), evidence)
        for number, wall in enumerate(plan.walls):
            edge = wall.edge
            foot = edge.offset_m * edge.normal
            walls.append([foot + t * edge.along for t in wall.span])
            wall_storeys.append(level)
            thickness.append(wall.thickness_m)
            angle = edge.angle_sigma
            wall_covariance.append(np.diag([edge.sigma_m**2 + edge.drift_m2 + (SCALE * edge.offset_m) ** 2, wall.thickness_sigma_m**2, angle**2]))
            unseen += [(first_wall + number, a - wall.span[0], b - wall.span[0]) for a, b in _unseen(wall, plan.openings, number)]
            planes = _planes_on(wall, evidence, map)
            used.update(planes)
            rows = np.unique(np.concatenate([e.views for _, e in wall.edges]))
            support += _supports("wall", first_wall + number, planes, rows, evidence)
        for number, room in enumerate(plan.rooms):
            rows = np.unique(np.concatenate([edge.views for loop in room.loops for edge in loop]))
            support += _supports("room", first_room + number, [], rows, evidence)
            for loop in room.loops:
                loops.append((first_room + number, len(corners), len(corners) + len(loop)))
                corners += [edge.begin for edge in loop]
                edge_sigmas += [edge.sigma_m for edge in loop]
                corner_walls += [first_wall + edge.wall if edge.wall >= 0 else -1 for edge in loop]
            area, variance = _area(room)
            areas.append(area)
            variances.append(variance)
            room_storeys.append(level)
            closed.append(all(edge.wall >= 0 for loop in room.loops for edge in loop))
        for opening in plan.openings:
            planes = _planes_on(plan.walls[opening.wall], evidence, map)
            support += _supports("opening", len(spans), planes, opening.views, evidence)
            start = plan.walls[opening.wall].span[0]
            spans.append([value - start for value in opening.span])
            heights.append(opening.heights)
            kinds.append(OPENING_KINDS.index(opening.kind))
            opening_walls.append(first_wall + opening.wall)
            opening_covariance.append(np.diag(np.square(opening.sigmas)))
            opening_rooms.append([first_room + room if room >= 0 else -1 for room in opening.rooms])
    return Building(
        state.index, state.stamp_ns, evidence.T_world_building, _note(plans),
        np.array([[plan.storey.floor_m, plan.storey.ceiling_m] for plan in plans]).reshape(-1, 2),
        np.array([np.diag([plan.storey.floor_sigma_m**2, plan.storey.ceiling_sigma_m**2]) for plan in plans]).reshape(-1, 2, 2),
        np.array(walls).reshape(-1, 2, 2), np.array(wall_storeys, np.int32), np.array(thickness, np.float64),
        np.array(wall_covariance).reshape(-1, 3, 3), np.array(unseen, np.float64).reshape(-1, 3), np.array(room_storeys, np.int32),
        np.array(loops, np.int32).reshape(-1, 3), np.array(corners, np.float64).reshape(-1, 2), np.array(corner_walls, np.int32),
        np.array(edge_sigmas, np.float64),
        np.array(areas, np.float64), np.array(variances, np.float64), np.array(closed, np.bool_), np.array(opening_walls, np.int32),
        np.array(kinds, np.uint8), np.array(spans, np.float64).reshape(-1, 2), np.array(heights, np.float64).reshape(-1, 2),
        np.array(opening_covariance).reshape(-1, 4, 4), np.array(opening_rooms, np.int32).reshape(-1, 2), _furniture(map, used, plans, evidence),
        np.array(support, np.int32).reshape(-1, 4),
    )  # fmt: skip


def _note(plans: list[StoreyPlan]) -> str:
    """Say what the plan lacks."""
    missing = []
    if not any(np.isfinite(plan.storey.floor_m) for plan in plans):
        missing.append("no floor was seen")
    if not any(np.isfinite(plan.storey.ceiling_m) for plan in plans):
        missing.append("no ceiling was seen")
    if not any(plan.rooms for plan in plans):
        count = sum(len(plan.walls) for plan in plans)
        missing.append(f"{count} wall{'s' if count != 1 else ''} seen, which bound{'s' if count == 1 else ''} no room")
    open_rooms = sum(any(edge.wall < 0 for loop in room.loops for edge in loop) for plan in plans for room in plan.rooms)
    if open_rooms:
        missing.append(f"{open_rooms} room{'s' if open_rooms != 1 else ''} not seen all round")
    return "; ".join([*missing, *dict.fromkeys(plan.remark for plan in plans if plan.remark)])


def _supports(kind: str, number: int, planes: list[int], rows: I32, evidence: Evidence) -> list[tuple[int, int, int, int]]:
    """Return the rows of `support` of one element."""
    out = [(ELEMENTS.index(kind), number, SUPPORTS.index("plane"), plane) for plane in planes]
    views = [evidence.views[row] for row in rows]
    out += [(ELEMENTS.index(kind), number, SUPPORTS.index("keyframe"), view.keyframe) for view in views if view.keyframe >= 0]
    return out + [(ELEMENTS.index(kind), number, SUPPORTS.index("frame"), view.index) for view in views]


AT_END = 4  # cells of an end of a wall, of which those at the wall that meets it there are seen with that


def _unseen(wall: WallPlan, openings: list[OpeningPlan], number: int) -> list[tuple[float, float]]:
    """Return the stretches along a wall without a reading on either face, in an edge of a room and not in an opening."""
    a, b = wall.span
    t = a + CELL_M / 2.0 + CELL_M * np.arange(max(int((b - a) / CELL_M), 0))
    seen, claimed = np.zeros(len(t), bool), np.zeros(len(t), bool)
    for _, edge in wall.edges:
        if edge.face is None:
            continue
        along = t if matmul(edge.normal, wall.edge.normal) > 0.0 else -t
        cell = ((along - edge.face.start_m) / CELL_M).astype(int)
        inside = (cell >= 0) & (cell < len(edge.face.count))
        seen[inside] |= edge.face.count[cell[inside]].any(axis=1)
        claimed |= (along > edge.span[0]) & (along < edge.span[1])
    for opening in openings:
        if opening.wall == number:
            seen |= (t > opening.span[0]) & (t < opening.span[1])
    marked = np.nonzero(claimed & ~seen)[0]
    runs = np.split(marked, np.nonzero(np.diff(marked) > 1)[0] + 1) if len(marked) else []
    long = [run for run in runs if len(run) >= 3]
    return [(a if run[0] < AT_END else a + CELL_M * run[0], b if run[-1] >= len(t) - AT_END else a + CELL_M * (run[-1] + 1)) for run in long]


def _area(room: RoomPlan) -> tuple[float, float]:
    """Return the area of a room and its variance: an edge that moves by 1 m changes the area by its length."""
    area, variance = 0.0, 0.0
    for loop in room.loops:
        for edge in loop:
            area += 0.5 * float(edge.begin[0] * edge.end[1] - edge.begin[1] * edge.end[0])
            length = float(norm(edge.end - edge.begin))
            sigma = edge.sigma_m if np.isfinite(edge.sigma_m) else CELL_M
            variance += (length * sigma) ** 2
    return area, variance


def _planes_on(wall: WallPlan, evidence: Evidence, map: Map | None) -> list[int]:
    """Return the ids of the map's living planes that lie on either face of a wall."""
    if map is None or len(map.planes) == 0:
        return []
    normals, _, points = _map_planes(evidence, map)
    edge, depth, found = wall.edge, wall.thickness_m, []
    for row in np.nonzero(map.planes.rows("alive", np.arange(len(map.planes))))[0]:
        seen = points[row][np.isfinite(points[row]).all(axis=1)]
        if len(seen) == 0:
            continue
        facing, off, t = (
            float(matmul(normals[row, :2], edge.normal)),
            matmul(seen[:, :2], edge.normal) - edge.offset_m,
            matmul(seen[:, :2], edge.along),
        )
        between = ((t > wall.span[0] - 0.1) & (t < wall.span[1] + 0.1)).mean() > 0.5
        near = np.abs(off).mean() < FIT_M if facing > 0.995 else facing < -0.995 and np.isfinite(depth) and np.abs(off + depth).mean() < FIT_M
        if between and near:
            found.append(int(row))
    return found


def _level_support(storey: Storey, evidence: Evidence, map: Map | None) -> tuple[list[int], I32]:
    """Return the ids of the map's living planes at a storey's floor or ceiling, and the views that show either."""
    rows, planes, levels = np.zeros(0, np.int32), list[int](), ((storey.floor_m, 1.0), (storey.ceiling_m, -1.0))
    for height, facing in levels:
        if np.isfinite(height):
            rows = np.union1d(rows, evidence.rows[at_level(evidence, height, facing)])
    if map is not None and len(map.planes):
        normals, offsets, _ = _map_planes(evidence, map)
        alive = map.planes.rows("alive", np.arange(len(map.planes)))
        for height, facing in levels:
            near = alive & (normals[:, 2] * facing > np.cos(np.radians(LEVEL_DEG))) & (np.abs(offsets + height * normals[:, 2]) < LEVEL_NEAR_M)
            planes += [int(row) for row in np.nonzero(near)[0]]
    return planes, rows.astype(np.int32)


def _map_planes(evidence: Evidence, map: Map) -> tuple[F64, F64, F64]:
    """Return normals (p, 3), offsets (p,) and samples (p, s, 3) of the map's planes in the building's frame."""
    ids = np.arange(len(map.planes))
    R, t = evidence.T_world_building[:3, :3], evidence.T_world_building[:3, 3]
    coefficients = map.planes.rows("coefficients", ids)
    samples = np.asarray(map.planes.rows("samples_m", ids), np.float64)
    return matmul(coefficients[:, :3], R), coefficients[:, 3] + matmul(coefficients[:, :3], t), matmul(samples - t, R)


def _furniture(map: Map | None, used: set[int], plans: list[StoreyPlan], evidence: Evidence) -> I32:
    """Return the ids of the map's planes that are neither a wall's nor a floor nor a ceiling."""
    if map is None or len(map.planes) == 0:
        return np.empty(0, np.int32)
    normals, offsets, _ = _map_planes(evidence, map)
    alive = map.planes.rows("alive", np.arange(len(map.planes)))
    levels = [height for plan in plans for height in (plan.storey.floor_m, plan.storey.ceiling_m)]
    found = []
    for row in np.nonzero(alive)[0]:
        height = -offsets[row] / normals[row, 2] if abs(normals[row, 2]) > 0.9 else float("nan")
        if row not in used and not any(abs(height - level) < 0.1 for level in levels):
            found.append(int(row))
    return np.array(found, np.int32)


AXES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])  # unit normals of faces along the building's two horizontal axes


def free_cells(cells: Cells) -> Bool:
    """Return the cells (n,) that are inside: those that rays passed."""
    return np.asarray(cells.free >= FREE_SHARE, np.bool_)


def plan_building(
    options: LayoutOptions,
    state: Gathered,
    map: Map | None,
    directions: Callable[[Evidence, Storey], F64],
    inside: Callable[[Cells], Bool] = free_cells,
    remark: Callable[[Evidence, Storey], str] = lambda evidence, storey: "",
) -> Building:
    """Make the plan of each storey at the final poses: faces, free space, cells, and of those that are inside, rooms, walls and openings.

    `directions` returns the unit normals (d, 2) that faces may have, `inside` the cells (n,) that are inside, `remark` what cannot be shown."""
    evidence = evidence_of(state, map)
    if evidence is None:
        return nothing(state, "no plane was seen")
    storeys, plans = storeys_of(evidence), []
    for number, storey in enumerate(storeys):
        here = in_storey(evidence, storeys, number)
        space = free_space(here, storey)
        faces = faces_of(here, storey, space, directions(here, storey), options.least_wall_m)
        cells = cells_of(faces, space)
        rooms = rooms_of(cells, inside(cells), faces, here, space, storey, options.least_room_m2)
        walls = walls_of(rooms, faces, here, storey, options.least_wall_m)
        openings = openings_of(walls, rooms, faces, here, space, storey)
        plans.append(StoreyPlan(storey, rooms, walls, openings, faces, remark(here, storey)))
    return assembled(state, evidence, plans, map)


def preview_state(state: Gathered) -> Gathered:
    """Return the state with PREVIEW_VIEWS of its views."""
    every = -(-len(state.views) // PREVIEW_VIEWS) if state.views else 1
    return replace(state, views=state.views[::every])


@dataclass(frozen=True)
class AtlantaOptions(LayoutOptions):
    """Options of walls at any angle."""

    apart_deg: Annotated[float, Range(2, 45)] = 6.0  # between directions
    least_m2: PositiveFloat = 1.0  # of tall points of a direction


def atlanta_directions(options: AtlantaOptions, evidence: Evidence, storey: Storey) -> F64:
    """Return the unit normals (d, 2) of the axes and of the other peaks."""
    more = np.radians(slanted_directions(evidence, storey, options.apart_deg, options.least_m2))
    one = np.stack([np.cos(more), np.sin(more)], axis=1)
    return np.concatenate([AXES, one, -one])


def in_storey(evidence: Evidence, storeys: list[Storey], number: int) -> Evidence:
    """Return the evidence between a storey's floor and the next."""
    if len(storeys) == 1:
        return evidence
    low = storeys[number].bottom_m - 0.2 if number else -np.inf
    high = storeys[number + 1].bottom_m - 0.2 if number + 1 < len(storeys) else np.inf
    return evidence.chosen((evidence.points[:, 2] >= low) & (evidence.points[:, 2] < high))
