"""Jogs of walls: the short sides of niches, of columns and of steps in a wall, which views hardly show."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, Bool
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import CROSSED, Face, crossing_levels, runs_of
from trihedron.plugins.building.free_space import CELL_M, FreeSpace
from trihedron.plugins.building.free_space_kernels import LEVELS
from trihedron.plugins.shared.voxel_hash_kernels import I64

DEPTH_M = (0.1, 1.0)  # of a jog
BESIDE_M, HIDDEN_M = 0.25, 1.0  # stretch in which the face behind is read, and how far from the end of the face in front it may begin
LEAST_PASSED = 2  # columns beyond an end that rays pass, for which the front ends there
SHORT_M = 0.2  # least wall that meets the ceiling: the side of a niche, a column
MOSTLY_BEHIND = 0.3  # of the levels at which the face behind is read, fewer than which the front is read beyond its end
END_M = 0.25  # of a face, whose readings say where it ends
WIDEST_DOOR_M = 1.6
CORRIDOR_M = 0.6  # of the walls of a corridor on either side of what meets them
THICKEST_M = 0.3  # wall between two faces
SAME_SIDE_M = 0.12  # from a face that was found


def jog_sides(faces: list[Face], evidence: Evidence, space: FreeSpace) -> list[Face]:
    """Return a face for each end of a tall stretch beyond which another face is read behind its line, or rays cross that: square to both, from one to
    the other."""
    found: list[Face] = []
    for front in faces:
        for a, b in runs_of(front.tall):
            if (b - a) * CELL_M < SHORT_M:
                continue
            for at_end in (False, True):
                at = b if at_end else a
                behind = [other for other in faces if _is_read_beyond(front, other, at, at_end)]
                if not behind and _is_passed_beyond(front, at, at_end, space):
                    behind = [other for other in faces if _stands_before(front, other, a, b)]
                if behind:
                    side = _side(front, max(behind, key=lambda other: other.offset_m), a, b, at_end, evidence, space)
                    if len(side.tall) and not any(_is_same(side, other) for other in (*faces, *found)):
                        found.append(side)
    return found


def parting_columns(face: Face, faces: list[Face]) -> Bool:
    """Return the columns (k,) of a face that part rooms: the tall ones, and gaps between them as wide as a door unless they are niches, as a face
    close behind shows, or a corridor between two walls that are square to the face."""
    out = face.tall.copy()
    for (_, a), (b, _) in pairwise(runs_of(face.tall)):
        niche = any(_is_read_beyond(face, other, a, True) or _is_read_beyond(face, other, b, False) for other in faces)
        corridor = all(any(_faces_gap(face, other, end, sign) for other in faces) for end, sign in ((a, 1.0), (b, -1.0)))
        if (b - a) * CELL_M <= WIDEST_DOOR_M and not niche and not corridor:
            out[a:b] = True
    return out


def _faces_gap(face: Face, other: Face, column: int, sign: float) -> bool:
    """Say if the other face is a wall at an end of a gap in a face, looks into the gap, and goes on before the face and behind it."""
    at = face.start_m + CELL_M * column
    if sign * float(matmul(other.normal, face.along)) < 0.999 or abs(sign * other.offset_m - at) > SAME_SIDE_M:
        return False
    crossing = float(matmul(face.offset_m * face.normal + at * face.along, other.along))
    return all(other.share(min(crossing, far), max(crossing, far), other.tall) > 0.5 for far in (crossing - CORRIDOR_M, crossing + CORRIDOR_M))


def _is_read_beyond(front: Face, other: Face, column: int, at_end: bool) -> bool:
    """Say if beyond an end of a stretch the front is not read, and the other face is, as far behind it as a jog is deep; next to the end it may be
    hidden."""
    if float(matmul(front.normal, other.normal)) < 0.999 or not DEPTH_M[0] < front.offset_m - other.offset_m < DEPTH_M[1]:
        return False
    end, width, hidden = front.start_m + CELL_M * column, round(BESIDE_M / CELL_M), round(HIDDEN_M / CELL_M)
    beyond = end + CELL_M * (np.arange(hidden + width) + 1.5) * (1.0 if at_end else -1.0)
    ahead, behind = (levels_read(face, np.asarray(beyond, np.float64)) for face in (front, other))
    first = int(np.argmax(behind > 0))
    there = behind[first : first + width]
    return bool(first < hidden and ahead[: first + width].sum() < MOSTLY_BEHIND * there.sum() and (there > 0).mean() > 0.5)


def _is_passed_beyond(front: Face, column: int, at_end: bool, space: FreeSpace) -> bool:
    """Say if rays pass the line of a front next to an end of a stretch: it ends there."""
    end, width = front.start_m + CELL_M * column, round(BESIDE_M / CELL_M)
    beyond = end + CELL_M * (np.arange(width) + 0.5) * (1.0 if at_end else -1.0)
    places = np.asarray(beyond, np.float64)
    ahead, passed = levels_read(front, places), crossing_levels(front, places, space).sum(axis=1)
    return bool(((passed >= CROSSED) & (ahead < MOSTLY_BEHIND * passed)).sum() >= LEAST_PASSED)


def _stands_before(front: Face, other: Face, a: int, b: int) -> bool:
    """Say if another face is that of the wall which a stretch stands before: it is read next to the stretch, on either side."""
    if float(matmul(front.normal, other.normal)) < 0.999 or not DEPTH_M[0] < front.offset_m - other.offset_m < DEPTH_M[1]:
        return False
    begin, stop = front.start_m + CELL_M * a - HIDDEN_M, front.start_m + CELL_M * b + HIDDEN_M
    return bool(other.tall[max(other.column_at(begin), 0) : max(other.column_at(stop), 0)].any())


def is_recess(wall: Face, begin_m: float, end_m: float, faces: list[Face]) -> bool:
    """Say if a face is read close behind most of a stretch of a wall: what is open there is a niche."""
    places = np.asarray(np.arange(begin_m + CELL_M / 2.0, end_m, CELL_M), np.float64)
    for face in faces:
        behind = float(matmul(face.normal, wall.normal)) > 0.999 and DEPTH_M[0] < wall.offset_m - face.offset_m < DEPTH_M[1]
        if behind and (levels_read(face, places) > 0).mean() > 0.5:
            return True
    return False


def levels_read(face: Face, along: F64) -> I64:
    """Return at how many levels a face was read at places (n,) along it."""
    column = np.floor((along - face.start_m) / CELL_M).astype(int)
    inside = (column >= 0) & (column < len(face.count))
    out = np.zeros(len(along), np.int64)
    out[inside] = (face.count[column[inside]] > 0).sum(axis=1)
    return out


def _side(front: Face, behind: Face, a: int, b: int, at_end: bool, evidence: Evidence, space: FreeSpace) -> Face:
    """Return the side from the end of the readings of a stretch to the face behind it, as far as no rays cross it."""
    begin, end = front.start_m + CELL_M * a, front.start_m + CELL_M * b
    along = matmul(evidence.points[front.members, :2], front.along)
    last = along[(along > end - END_M) & (along < end + CELL_M)] if at_end else along[(along > begin - CELL_M) & (along < begin + END_M)]
    at = float(np.percentile(last, 99.0 if at_end else 1.0)) if len(last) else end if at_end else begin
    sign = 1.0 if at_end else -1.0
    normal = sign * front.along
    line = Face(normal, sign * at, 0.0, np.zeros((0, LEVELS), np.int32), np.zeros(0, np.bool_), np.empty(0, np.int64))
    away = -float(matmul(front.normal, line.along))  # 1 or -1: behind the front
    steps = np.arange(max(round((front.offset_m - behind.offset_m) / CELL_M), 1)) + 0.5
    crossed = crossing_levels(line, np.asarray(away * (CELL_M * steps - front.offset_m), np.float64), space).sum(axis=1) >= CROSSED
    cells = int(np.argmax(crossed)) if crossed.any() else len(steps)
    count, every = np.zeros((cells, LEVELS), np.int32), np.ones(cells, np.bool_)
    count[:, 0] = 1
    start = min(-away * front.offset_m, away * (CELL_M * cells - front.offset_m))
    return replace(line, start_m=start, count=count, tall=every, known=every)


def _is_same(side: Face, other: Face) -> bool:
    """Say if a face that was found is about where the side is."""
    if float(matmul(side.normal, other.normal)) < 0.999 or abs(side.offset_m - other.offset_m) > SAME_SIDE_M:
        return False
    begin, end = side.start_m, side.start_m + CELL_M * len(side.count)
    return other.share(begin, end, np.asarray(other.count.any(axis=1), np.bool_)) > 0.5
