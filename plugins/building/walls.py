"""Walls: the edges of rooms that lie on one face or back to back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.plugins.building.cell_complex import TALL_SHARE
from trihedron.plugins.building.edges import THICKEST_M, THINNEST_M, Edge, fit_edge
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import Face, runs_of
from trihedron.plugins.building.free_space import CELL_M
from trihedron.plugins.building.levels import Storey
from trihedron.plugins.building.rooms import RoomPlan, room_at

AROUND_M = 0.3  # an opening, where the readings of its wall are those of its jambs, lintel and sill


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
            if _are_one_wall(first, edges[j][1]):
                group[root(i)] = root(j)
    found: list[WallPlan] = []
    for number in sorted({root(k) for k in range(len(edges))}):
        members = [edges[k] for k in range(len(edges)) if root(k) == number]
        found.append(_wall(members, faces, len(found)))
    stretches = [(face, a, b) for face in faces for a, b in _stretches(face, least_m)]
    for face, a, b in sorted(stretches, key=lambda item: item[1] - item[2]):
        foot = face.offset_m * face.normal
        edge = Edge(face.normal, face.offset_m, face, foot + a * face.along, foot + b * face.along)
        if any(_is_beside(edge, wall) for wall in found):
            continue
        fit_edge(edge, evidence, storey)
        wall = _wall([(-1, edge)], faces, len(found))
        if np.isfinite(wall.thickness_m) or not _is_within_room(edge, rooms):
            found.append(wall)
    return found


def _is_within_room(edge: Edge, rooms: list[RoomPlan]) -> bool:
    """Say if a room is on both sides of an edge, as it is of furniture of which no ray got behind."""
    middle = (edge.begin + edge.end) / 2.0
    before, behind = (room_at(rooms, middle + side * AROUND_M / 2.0 * edge.normal) for side in (1.0, -1.0))
    return before >= 0 and before == behind


def _stretches(face: Face, least_m: float) -> list[tuple[float, float]]:
    """Return begin and end along a face of its tall stretches of at least a length."""
    runs = [(face.start_m + CELL_M * a, face.start_m + CELL_M * b) for a, b in runs_of(face.tall)]
    return [(a, b) for a, b in runs if b - a >= least_m - 1e-9]


def _is_beside(edge: Edge, wall: WallPlan) -> bool:
    """Say if an edge is one of a wall's faces, or so near to one that the readings may be furniture before it or stray ones behind it."""
    facing = float(matmul(edge.normal, wall.edge.normal))
    (a, b), (c, d) = edge.span, wall.span if facing > 0.0 else (-wall.span[1], -wall.span[0])
    away = edge.offset_m - np.sign(facing) * wall.edge.offset_m
    return abs(facing) > 0.99 and abs(away) < THICKEST_M and min(b, d) - max(a, c) > 0.0


def _are_one_wall(a: Edge, b: Edge) -> bool:
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
