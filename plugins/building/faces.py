"""Faces of walls: vertical planes that planar regions of several views show, seen from one side.

*Tall* stretches of a face reach above doors and furniture."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.free_space import CELL_M, LEVEL_M, FreeSpace
from trihedron.plugins.building.free_space_kernels import LEVELS, U32
from trihedron.plugins.building.levels import Storey, sliding_sum
from trihedron.plugins.shared.voxel_hash_kernels import I64

TALL_M = 2.15  # above doors and most furniture
BELOW_CEILING_M = 0.25
CONE_DEG = 6.0  # between a region's normal and that of its face, at most
SNAP_DEG = 3.0  # a direction nearer to an axis of the building is that axis
BINS = 180  # of 1°
PEAK = 3  # cm to both sides of a peak of the offsets
SAME_FACE_M = 0.1  # of two faces of one direction and stretch that are nearer to each other, the lesser is furniture
NEAR_FACE_M = 0.05
LEAST_READINGS = 2  # for which a column reaches high
HIGH_M = 1.5  # reached by a column that rays neither pass over nor get behind
ASIDE_M = 0.1  # before and behind a face, where a ray that crosses it is sought
CROSSED = 2  # levels of rays over a column, for which it ends below the ceiling


@dataclass(frozen=True)
class Face:
    """A line n·p = offset in the plan, with n towards the side it was seen from, and its `count` (k, LEVELS) of readings: cells of CELL_M along
    `along` from `start_m`, levels of LEVEL_M above the storey's floor."""

    normal: F64
    offset_m: float
    start_m: float
    count: I32
    tall: Bool  # (k,) columns that reach high
    members: I64  # its points in the evidence
    known: Bool = field(default_factory=lambda: np.zeros(0, np.bool_))  # (k,) columns of walls for certain; none before `tall_furniture`

    @property
    def along(self) -> F64:
        """Return the unit direction (2,) with the seen side on its left."""
        return np.array([self.normal[1], -self.normal[0]])

    def share(self, begin_m: float, end_m: float, columns: Bool) -> float:
        """Return the share of a stretch whose columns (k,) are marked."""
        a, b = self.column_at(begin_m), self.column_at(end_m)
        return float(columns[max(a, 0) : max(b, 0)].sum()) / (b - a) if b > a else float(columns[min(max(a, 0), len(columns) - 1)])

    def column_at(self, along_m: float) -> int:
        """Return the number of the column that begins nearest to a place along the face; it may be none of its own."""
        return round((along_m - self.start_m) / CELL_M)


def tall_m(storey: Storey) -> float:
    """Return the height above the floor that only walls reach, or that nothing much was seen above."""
    top = storey.ceiling_m if np.isfinite(storey.ceiling_m) else storey.reach_m
    return float(min(TALL_M, top - storey.bottom_m - BELOW_CEILING_M))


def faces_of(upright: list[Face], storey: Storey, space: FreeSpace, least_m: float) -> list[Face]:
    """Choose the faces, of `upright_faces`, that reach high over a stretch of at least that length."""
    found: list[Face] = []
    for face in upright:
        face = replace(face, tall=close_gaps(_tall_columns(face, space, storey)))
        if longest_run(face.tall) * CELL_M >= least_m and not any(_hides(other, face) for other in found):
            found.append(face)
    return found


def upright_faces(evidence: Evidence, storey: Storey, directions: F64) -> list[Face]:
    """Find the faces with unit normals among `directions` (d, 2), high and low; of each direction the strongest first."""
    found: list[Face] = []
    height = evidence.points[:, 2] - storey.bottom_m
    top = storey.ceiling_m - storey.bottom_m - 0.05 if np.isfinite(storey.ceiling_m) else LEVELS * LEVEL_M
    upright = np.nonzero(evidence.upright & (height > 0.0) & (height < top))[0]
    normals = evidence.normals[upright, :2]
    for normal in directions:
        facing = matmul(normals, normal) > np.cos(np.radians(CONE_DEG))
        found += _faces_along(evidence, height, normal, upright[facing], storey)
    return found


def _faces_along(evidence: Evidence, height: F64, normal: F64, members: I64, storey: Storey) -> list[Face]:
    """Find the faces of one direction: the peaks of the offsets of its points above HIGH_M."""
    high = height[members] > min(HIGH_M, tall_m(storey))
    if not high.any():
        return []
    offsets = matmul(evidence.points[members, :2], normal)
    along = matmul(evidence.points[members, :2], np.array([normal[1], -normal[0]]))
    levels = np.clip((height[members] / LEVEL_M).astype(int), 0, LEVELS - 1)
    weight = np.sqrt(evidence.information[members]) * evidence.area_m2[members]
    high_offsets, high_weight = offsets[high], weight[high]
    low = float(high_offsets.min()) - 0.1
    bins = np.bincount(((high_offsets - low) / 0.01).astype(int), high_weight)
    smooth = sliding_sum(np.concatenate([bins, np.zeros(10)]), np.array([0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25]))
    padded = np.concatenate([np.full(PEAK, -1.0), smooth, np.full(PEAK, -1.0)])
    peaks = [k for k in np.nonzero(smooth > 0.0)[0] if smooth[k] >= padded[k : k + 2 * PEAK + 1].max()]
    found: list[Face] = []
    for best in sorted(peaks, key=lambda k: -smooth[k]):
        near = np.abs(high_offsets - (low + (best + 0.5) * 0.01)) < 0.03
        if not near.any():
            continue
        offset = float(np.average(high_offsets[near], weights=high_weight[near]))
        close = np.nonzero(np.abs(offsets - offset) < NEAR_FACE_M)[0]
        start = float(along[close].min())
        columns = ((along[close] - start) / CELL_M).astype(int)
        width = int(columns.max()) + 1
        count = np.bincount(columns * LEVELS + levels[close], minlength=width * LEVELS).reshape(width, LEVELS).astype(np.int32)
        found.append(Face(normal, offset, start, count, np.zeros(width, np.bool_), members[close]))
    return found


def _hides(greater: Face, lesser: Face) -> bool:
    """Say if a face is furniture on a greater one, or its stray readings."""
    away = abs(greater.offset_m - lesser.offset_m)
    if float(matmul(greater.normal, lesser.normal)) < 0.999 or away >= SAME_FACE_M:
        return False
    beside = [greater.share(lesser.start_m + CELL_M * a, lesser.start_m + CELL_M * b, greater.tall) for a, b in runs_of(lesser.tall)]
    return away < NEAR_FACE_M or max(beside) > 0.2


def _tall_columns(face: Face, space: FreeSpace, storey: Storey) -> Bool:
    """Return the columns (k,) of a face that reach high and that rays do not pass over: above doors and furniture, or to HIGH_M where rays get behind
    at less than half of the levels that were read, which noise does."""
    top = np.where(face.count.any(axis=1), LEVELS - 1 - np.argmax(face.count[:, ::-1] > 0, axis=1), -1)
    levels = np.arange(LEVELS)
    tall = face.count[:, levels * LEVEL_M > tall_m(storey)].sum(axis=1) >= LEAST_READINGS
    places = np.asarray(face.start_m + (np.arange(len(top)) + 0.5) * CELL_M, np.float64)
    passed = _bits(space.at(places[:, None] * face.along + (face.offset_m - ASIDE_M) * face.normal))
    over = crossing_levels(face, places, space) & (levels > top[:, None] + 1)
    solid = (top * LEVEL_M >= HIGH_M) & (2 * passed.sum(axis=1) < (face.count > 0).sum(axis=1))
    return np.asarray((tall | solid) & (over.sum(axis=1) < CROSSED), np.bool_)


def crossing_levels(face: Face, along: F64, space: FreeSpace) -> Bool:
    """Return the levels (n, LEVELS) that rays passed before, on and behind the line of a face at places (n,) along it."""
    line = along[:, None] * face.along + face.offset_m * face.normal
    return _bits(space.at(line - ASIDE_M * face.normal) & space.at(line) & space.at(line + ASIDE_M * face.normal))


def _bits(levels: U32) -> Bool:
    """Return the bits (n, LEVELS) of levels (n,)."""
    return np.asarray((levels[:, None] >> np.arange(LEVELS, dtype=np.uint32)) & np.uint32(1), np.bool_)


def runs_of(columns: Bool) -> list[tuple[int, int]]:
    """Return begin and end of each run of marked columns."""
    ends = np.nonzero(np.diff(np.concatenate([[False], columns, [False]])))[0]
    return [(int(a), int(b)) for a, b in ends.reshape(-1, 2)]


def longest_run(columns: Bool) -> int:
    """Return the length of the longest run of marked columns."""
    return max((b - a for a, b in runs_of(columns)), default=0)


def close_gaps(columns: Bool, gap: int = 2) -> Bool:
    """Close gaps of so many columns or fewer."""
    out = columns.copy()
    marked = np.nonzero(columns)[0]
    for a, b in pairwise(marked):
        if b - a <= gap + 1:
            out[a:b] = True
    return out


def slanted_directions(evidence: Evidence, storey: Storey, apart_deg: float, least_m2: float) -> F64:
    """Return the directions (n,) of walls along neither axis, degrees: peaks with at least that area of tall points."""
    tall = evidence.upright & (evidence.points[:, 2] - storey.bottom_m > tall_m(storey))
    angles = np.mod(np.degrees(np.arctan2(evidence.normals[tall, 1], evidence.normals[tall, 0])), 180.0)
    weight = evidence.area_m2[tall]
    histogram = np.bincount(angles.astype(int) % BINS, weight, BINS)
    smooth = sum((np.roll(histogram, k) for k in (-2, -1, 1, 2)), histogram)
    found = [0.0, 90.0]
    for best in np.argsort(-smooth, kind="stable"):
        near = np.abs(_axial_difference(angles, best + 0.5)) < 2.5
        if smooth[best] < least_m2 or not weight[near].any():
            break
        angle = best + 0.5 + float(np.average(_axial_difference(angles[near], best + 0.5), weights=weight[near]))
        if all(abs(float(_axial_difference(np.array(angle), other))) > max(apart_deg, SNAP_DEG) for other in found):
            found.append(angle)
    return np.array(found[2:])


def _axial_difference(angles: F64, middle: float) -> F64:
    """Return by how much directions modulo 180° are turned from another, in degrees."""
    return np.asarray(np.mod(angles - middle + 90.0, 180.0) - 90.0)
