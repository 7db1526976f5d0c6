"""Edges of rooms, each fitted to the points of its own stretch of a face, so that drift between rooms stays between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trihedron.pipeline.core.linalg import det, matmul, norm, solve
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.building.cell_complex import TALL_SHARE
from trihedron.plugins.building.evidence import SCALE, Evidence, drift_variance, mean_over_views
from trihedron.plugins.building.faces import Face, tall_m
from trihedron.plugins.building.free_space import CELL_M
from trihedron.plugins.building.levels import Storey

ON_WALL_SHARE = 0.3  # of a room's edge, for which it is a wall
SAME_LINE_M = 0.02
GLIMPSE_SHARE = 0.1  # the same where the wall was seen from behind
THICKEST_M, THINNEST_M = 0.5, 0.03
FIT_M = 0.04  # about an edge, within which points take part in its fit
LEAST_POINTS = 100
AXIS = 1.0 - 1e-9  # greatest component of a normal along an axis of the building
LEAST_OPEN_M = 0.15  # of an edge beyond the last reading


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


def edges_of_ring(ring: Any, faces: list[Face]) -> list[Edge]:
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
        glimpsed = share >= GLIMPSE_SHARE and _is_backed(normal, float(matmul(p, normal)), p, q, faces)
        on = best if share >= ON_WALL_SHARE or glimpsed else None
        out.append(Edge(on.normal if on is not None else normal, float(matmul(p, normal)) if on is None else on.offset_m, on, p, q))
    return out


def _is_backed(normal: F64, offset_m: float, p: F64, q: F64, faces: list[Face]) -> bool:
    """Say if the other face of a wall, which was seen from behind, covers most of a stretch from p to q of a line."""
    return any(
        float(matmul(other.normal, normal)) < -0.999
        and -SAME_LINE_M < offset_m + other.offset_m < THICKEST_M
        and other.share(float(matmul(q, other.along)), float(matmul(p, other.along)), other.tall) > TALL_SHARE
        for other in faces
    )


def fit_edge(edge: Edge, evidence: Evidence, storey: Storey) -> None:
    """Fit the edge's offset to the points of its own stretch, those above doors and pictures if there are enough; without any it is where its face
    ends, to half a cell."""
    if edge.face is None:
        return
    members = evidence.points[edge.face.members, :2]
    for _ in range(2):
        mask = edge.face.members[_are_on_edge(edge, members, min(0.1, (edge.span[1] - edge.span[0]) / 4.0))]
        high = mask[evidence.points[mask, 2] - storey.bottom_m > tall_m(storey)]
        mask = high if len(high) >= LEAST_POINTS else mask
        if len(mask) == 0:
            edge.sigma_m = CELL_M / 2.0 if np.isnan(edge.sigma_m) else edge.sigma_m
            return
        rows = evidence.rows[mask]
        offset, sigma = mean_over_views(matmul(evidence.points[mask, :2], edge.normal), evidence.information[mask], rows)
        edge.offset_m, edge.sigma_m, edge.views = offset, sigma, np.unique(rows)
        edge.drift_m2 = drift_variance(evidence, np.array([*edge.normal, 0.0]), evidence.information[mask], rows)
        t = matmul(evidence.points[mask, :2], edge.along)
        if np.abs(edge.normal).max() < AXIS:
            rotate_edge(edge, evidence.points[mask, :2], evidence.information[mask])
        edge.angle_sigma = float(np.hypot(sigma / max(float(t.std()) * 2.0, 0.1), np.radians(0.03)))


def _are_on_edge(edge: Edge, points: F64, end_m: float) -> Bool:
    """Say of points (n, 2) if they lie on an edge, within FIT_M of its line and not within `end_m` of its ends."""
    a, b = edge.span
    t, off = matmul(points, edge.along), matmul(points, edge.normal) - edge.offset_m
    return np.asarray((np.abs(off) < FIT_M) & (t > a + end_m) & (t < b - end_m))


def rotate_edge(edge: Edge, points: F64, information: F64) -> None:
    """Turn an edge that is along no axis of the building to its own points (n, 2)."""
    t, off = matmul(points, edge.along), matmul(points, edge.normal) - edge.offset_m
    middle = float(np.average(t, weights=information))
    spread = float(matmul(information, (t - middle) ** 2))
    slope = float(matmul(information, (t - middle) * off)) / spread if spread > 0.0 else 0.0
    centre = middle * edge.along + edge.offset_m * edge.normal
    normal = edge.normal - slope * edge.along
    edge.normal = normal / norm(normal)
    edge.offset_m = float(matmul(centre, edge.normal))


def end_at_readings(loop: list[Edge], faces: list[Face]) -> list[Edge]:
    """Let edges on a face end where its readings do, if nothing bounds the room beyond; the rest is an edge that nothing bounds either."""
    out: list[Edge] = []
    for before, edge, after in zip([loop[-1], *loop[:-1]], loop, [*loop[1:], loop[0]]):
        pieces = [edge]
        a, b = float(matmul(edge.begin, edge.along)), float(matmul(edge.end, edge.along))
        for open_end, neighbour in ((False, before), (True, after)):
            if edge.face is None or _is_bounded(neighbour, faces) or (seen := _readings_of(edge.face, a, b)) is None:
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


def _is_bounded(edge: Edge, faces: list[Face]) -> bool:
    """Say if there is a wall at an edge, seen from either side."""
    return edge.face is not None or _is_backed(edge.normal, edge.offset_m, edge.begin, edge.end, faces)


def _readings_of(face: Face, a: float, b: float) -> tuple[float, float] | None:
    """Return where along a face its readings between two places begin and end, or None without any."""
    starts = face.start_m + CELL_M * np.nonzero(face.count.any(axis=1))[0]
    inside = starts[(starts + CELL_M > a) & (starts < b)]
    return (max(float(inside[0]), a), min(float(inside[-1]) + CELL_M, b)) if len(inside) else None


def intersect_edges(loop: list[Edge]) -> None:
    """Put the corners of a ring where its edges' lines meet."""
    for before, edge in zip([loop[-1], *loop[:-1]], loop):
        A = np.stack([before.normal, edge.normal])
        if abs(det(A)) > 0.05:
            corner = np.asarray(solve(A, [before.offset_m, edge.offset_m]), np.float64)
        else:
            corner = edge.begin + (edge.offset_m - matmul(edge.begin, edge.normal)) * edge.normal
        before.end, edge.begin = corner, corner


def make_relative(edges: list[Edge]) -> None:
    """Add to the edges of a room the drift that they do not have in common, and what the scale may move them from its middle."""
    middle = np.mean([edge.begin for edge in edges], axis=0)
    common = min((edge.drift_m2 for edge in edges if edge.face is not None), default=0.0)
    for edge in edges:
        size = SCALE * (edge.offset_m - matmul(middle, edge.normal))
        edge.sigma_m = float(np.sqrt(edge.sigma_m**2 + size**2 + max(edge.drift_m2 - common, 0.0)))
        edge.drift_m2 = common
