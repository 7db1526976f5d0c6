"""Openings: where rays cross a wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.building.edges import FIT_M
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import Face
from trihedron.plugins.building.free_space import CELL_M, LEVEL_M, FreeSpace
from trihedron.plugins.building.free_space_kernels import LEVELS, U32
from trihedron.plugins.building.jogs import DEPTH_M, WIDEST_DOOR_M, is_recess
from trihedron.plugins.building.levels import Storey, sliding_sum
from trihedron.plugins.building.mirrors import LEAST_WEIGHT, UprightReadings, reflection_evidence
from trihedron.plugins.building.rooms import RoomPlan, room_at
from trihedron.plugins.building.walls import AROUND_M, WallPlan

WINDOW_M = 0.35  # least height of a window's sill
STEP_M = 0.025
BEHIND_M = 0.1  # a ray that gets so far behind a wall has crossed it
NARROWEST_M = 0.4
LEAST_LEVELS = 5
SPARSE = 0.2  # of the readings beside it, fewer than which an opening has: a wall's that lets rays through by their noise is as dense as ever
END_STEP_M = 0.01


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
    walls: list[WallPlan], rooms: list[RoomPlan], faces: list[Face], evidence: Evidence, space: FreeSpace, storey: Storey, readings: UprightReadings
) -> list[OpeningPlan]:
    """Find the stretches of each wall that rays cross from well before it to well behind it, at the same heights, but those that
    `readings` show to be mirrors."""
    found = []
    for number, wall in enumerate(walls):
        levels = _crossing_levels(wall, space)
        crossed = np.array([bin(int(value)).count("1") >= 3 for value in levels], bool)
        marked = np.nonzero(_close_gaps(crossed))[0]
        for run in np.split(marked, np.nonzero(np.diff(marked) > 1)[0] + 1) if len(marked) else []:
            opening = _opening(number, wall, run, levels, evidence, storey, rooms, faces)
            if opening is not None and not is_niche(opening, wall, space) and not _is_mirror(opening, wall, storey, space, readings):
                found.append(opening)
    return found


def is_niche(opening: OpeningPlan, wall: WallPlan, space: FreeSpace) -> bool:
    """Say if no ray gets farther behind an opening, on the side where there is no room, than into a niche, whose back need not have been read."""
    front, back = opening.rooms
    if min(front, back) >= 0:
        return False
    thickness = wall.thickness_m if np.isfinite(wall.thickness_m) else 0.0
    off = -(thickness + DEPTH_M[1]) if back < 0 else DEPTH_M[1]
    along = np.arange(opening.span[0], opening.span[1], CELL_M / 2.0)
    return not space.at(along[:, None] * wall.edge.along + (wall.edge.offset_m + off) * wall.edge.normal).any()


def _is_mirror(opening: OpeningPlan, wall: WallPlan, storey: Storey, space: FreeSpace, readings: UprightReadings) -> bool:
    """Say if an opening is a mirror on either side of its wall, as it is taken for where nothing decides and there is a room on one side only."""
    (a, b), (low, high), evidence = opening.span, opening.heights, 0.0
    depth = wall.thickness_m if np.isfinite(wall.thickness_m) else 0.0
    for face in {id(edge.face): edge.face for _, edge in wall.edges if edge.face is not None}.values():
        span = (a, b) if matmul(face.normal, wall.edge.normal) > 0.0 else (-b, -a)
        evidence += reflection_evidence(face, span, (storey.bottom_m + low, storey.bottom_m + high), depth, readings, space, storey)
    return evidence >= LEAST_WEIGHT or (evidence > -LEAST_WEIGHT and min(opening.rooms) < 0)


def _close_gaps(columns: Bool) -> Bool:
    """Close gaps of one column."""
    return np.asarray(columns | (np.roll(columns, 1) & np.roll(columns, -1)), np.bool_)


def _crossing_levels(wall: WallPlan, space: FreeSpace) -> U32:
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
    gap = widest_gap(a, b, _between_levels(open_levels, *near))
    if gap is None:
        return None
    a, b, sigma_side, jambs = fit_jambs(*gap, _between_levels(open_levels, *near))
    if b - a < NARROWEST_M or (wall.edge.face is not None and is_recess(wall.edge.face, a, b, faces)):
        return None
    bottom, top, sigma_top, lintel = _heights(a, b, open_levels, *near)
    ceiling = storey.ceiling_m - storey.bottom_m if np.isfinite(storey.ceiling_m) else float("inf")
    door = (jambs or lintel) and b - a <= WIDEST_DOOR_M and top <= ceiling - 0.1
    kind = "window" if bottom > WINDOW_M else "door" if door else "passage"
    sigmas = (sigma_side, sigma_side, 0.02 if bottom else 0.01, sigma_top)
    middle = (a + b) / 2.0 * wall.edge.along + wall.edge.offset_m * wall.edge.normal
    depth = wall.thickness_m if np.isfinite(wall.thickness_m) else 0.0
    front, *back = (room_at(rooms, middle + off * wall.edge.normal) for off in (0.1, -depth - 0.1, -depth - 0.2, -depth - 0.35))
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


def widest_gap(a: float, b: float, readings: F64) -> tuple[float, float] | None:
    """Return begin and end of the widest part of a crossed stretch that has next to no readings of the wall, or None where it is too narrow."""
    count = max(round((b - a) / CELL_M), 1)
    dense = np.histogram(readings, count + 12, (a - 6 * CELL_M, a + (count + 6) * CELL_M))[0]
    usual = float(np.median(dense[dense > 0])) if dense.any() else 0.0
    ends = np.nonzero(np.diff(np.concatenate([[False], dense[6:-6] <= SPARSE * usual, [False]])))[0].reshape(-1, 2)
    if len(ends) == 0:
        return None
    first, stop = ends[np.argmax(ends[:, 1] - ends[:, 0])]
    return (a + CELL_M * float(first), a + CELL_M * float(stop)) if CELL_M * (stop - first) >= NARROWEST_M - CELL_M else None


def fit_jambs(a: float, b: float, low: F64) -> tuple[float, float, float, bool]:
    """Move the sides of an opening to where the wall's readings (k,) along it end; the standard deviation of the sides, and if both were seen."""
    middle = (a + b) / 2.0
    left = _end_of(middle - low[(low < middle) & (low > a - 0.3)], middle - a)
    right = _end_of(low[(low > middle) & (low < b + 0.3)] - middle, b - middle)
    known = np.isfinite([left, right])
    return middle - left if known[0] else a, middle + right if known[1] else b, 0.015 if known.all() else CELL_M / 2.0, bool(known.all())


def _end_of(away: F64, guess_m: float) -> float:
    """Return the distance at which readings (n,) become half as dense as they are beyond `guess_m`; NaN when there are too few."""
    if (away > guess_m).sum() < 30:
        return float("nan")
    density = np.bincount((away / END_STEP_M).astype(int), minlength=int(guess_m / END_STEP_M) + 1)
    beyond = density[int((guess_m + CELL_M) / END_STEP_M) :]
    if len(beyond) == 0 or np.median(beyond) == 0.0:
        return float("nan")
    smooth = sliding_sum(density, np.ones(3) / 3.0)
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
