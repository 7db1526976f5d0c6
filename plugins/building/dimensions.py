"""Chains of dimensions round a storey: distances between the inner faces of walls, as they are met from each side of the plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from trihedron.pipeline.core.plan_areas import edges_of
from trihedron.pipeline.core.types import F64, Building
from trihedron.plugins.building.geometry import rooms_on

SAME_M = 0.02  # between places that one tick marks, and between chains of which one is enough
FACING = 0.3  # of an edge's normal, towards a side, from which the side sees the edge


@dataclass(frozen=True)
class Chain:
    """Stretches (begin, end) along an axis (0 = x, 1 = y), m, met from the low side or the high one; and the whole of them, where its ends are walls.

    A stretch is that of a room's edge or of a gap between two; one that nothing bounds is left out."""

    axis: int
    high: bool
    stretches: tuple[tuple[float, float], ...]
    whole: tuple[float, float] | None

    @property
    def rows(self) -> list[tuple[tuple[float, float], ...]]:
        """Return the rows that are drawn, from the plan outwards."""
        return [self.stretches, *([(self.whole,)] if self.whole else [])]


@dataclass(frozen=True, eq=False)
class _Edge:
    """An edge of a room: its ends (2, 2), the least first along the axis, and if a wall bounds it."""

    ends: F64
    bounded: bool


def chains_of(building: Building, storey: int) -> list[Chain]:
    """Return the chains of a storey, without those on a high side that repeat the ones opposite."""
    out = []
    for axis in (0, 1):
        low, high = (_chain(building, storey, axis, side) for side in (False, True))
        out += [low] if low.stretches else []
        if high.stretches and not _equal(low.stretches, high.stretches):
            out.append(Chain(axis, True, high.stretches, None) if low.whole and high.whole and _equal((low.whole,), (high.whole,)) else high)
    return out


def covers(chains: list[Chain], p: F64, q: F64) -> bool:
    """Say if a chain gives the distance of two points along its axis."""
    return any(
        abs(p[1 - chain.axis] - q[1 - chain.axis]) < SAME_M and _equal((tuple(sorted((p[chain.axis], q[chain.axis]))),), (stretch,))
        for chain in chains
        for row in chain.rows
        for stretch in row
    )


def _equal(first: tuple[tuple[float, float], ...], second: tuple[tuple[float, float], ...]) -> bool:
    return len(first) == len(second) and bool(np.allclose(first, second, rtol=0.0, atol=SAME_M))


def _chain(building: Building, storey: int, axis: int, high: bool) -> Chain:
    edges = list(_edges(building, storey, axis, high))
    stops = _distinct(np.concatenate([edge.ends[:, axis] for edge in edges])) if edges else np.empty(0)
    met = [(a, b, _outermost(edges, axis, high, (a + b) / 2.0)) for a, b in pairwise(stops.tolist())]
    runs = [list(run) for _, run in groupby(met, key=lambda item: item[2])]
    kept = [(run[0][0], run[-1][1]) for run in runs if run[0][2] is None or run[0][2].bounded]
    ends_seen = bool(kept) and kept[0][0] == stops[0] and kept[-1][1] == stops[-1]
    return Chain(axis, high, tuple(kept), (float(stops[0]), float(stops[-1])) if ends_seen and len(kept) > 1 else None)


def _edges(building: Building, storey: int, axis: int, high: bool) -> Iterator[_Edge]:
    """Yield the edges of a storey's rooms that a side sees."""
    for room in rooms_on(building, storey):
        for p, q, wall in edges_of(building, room):
            outward = np.array([q[1] - p[1], p[0] - q[0]]) / max(float(np.hypot(*(q - p))), 1e-9)
            if outward[1 - axis] * (1.0 if high else -1.0) > FACING:
                yield _Edge(np.array(sorted((p, q), key=lambda end: float(end[axis]))), wall >= 0)


def _distinct(places: F64) -> F64:
    """Return places in order, one of those that are next to each other."""
    ordered: F64 = np.sort(places)
    kept: F64 = ordered[np.concatenate([[True], np.diff(ordered) > SAME_M])]
    return kept


def _outermost(edges: list[_Edge], axis: int, high: bool, place: float) -> _Edge | None:
    """Return the edge that a side meets first at a place along the axis; None where it meets none."""
    there = [edge for edge in edges if edge.ends[0, axis] < place < edge.ends[1, axis]]
    depths = [float(np.interp(place, edge.ends[:, axis], edge.ends[:, 1 - axis])) for edge in there]
    return there[int(np.argmax(depths) if high else np.argmin(depths))] if there else None
