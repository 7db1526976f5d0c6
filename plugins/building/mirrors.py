"""Mirrors: where views read, through the line of a face, what they read before it as well, reflected. Such readings are put onto the face."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.building.edges import FIT_M
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import HIGH_M, LEAST_READINGS, Face, close_gaps, longest_run, runs_of
from trihedron.plugins.building.free_space import CELL_M, LEVEL_M, FreeSpace
from trihedron.plugins.building.free_space_kernels import LEVELS
from trihedron.plugins.building.levels import Storey, sliding_sum
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.voxel_hash_kernels import I64

EVERY = 4  # of the readings, one is compared
BEFORE_M, BEHIND_M = 0.3, 0.15  # of an eye and of its reading, for a ray that crosses a face
FACING = 0.7  # cosine, of surfaces that face a line, others are square to it
SAME_M = 0.1  # side of the voxels in which readings are the same
NEIGHBOURS = (0, 1 << 42, -(1 << 42), 1 << 22, -(1 << 22), 4, -4)  # steps of keys to voxels that share a side
REACH = 3  # columns, of a face to the wall square to it that it reaches
BROAD, LEAST_WEIGHT = 3, 4.0  # neighbouring columns of a face that are judged together, the evidence that decides
MOVED = 1e-4  # of the information of a reading that is put onto a mirror, which does not say where that is
NARROWEST_M, RIM_M = 0.25, 0.05
BLOCKED_M = 0.8  # behind a face, for furniture and curtains on the other side of its wall
ASIDE_M = 0.4  # from the way of the camera to the jamb of what it goes through
LEAST_FACE_M, WIDEST_M = 0.2, 1.2  # of a face that is read, of a gap in it and of what is beside it


@dataclass(frozen=True)
class Mirror:
    """The part of the line n·p = offset of a face between two places along it and two heights, m."""

    normal: F64
    offset_m: float
    span: tuple[float, float]
    heights: tuple[float, float]

    def crossing(self, eye: F64, points: F64) -> tuple[F64, Bool]:
        """Return the shares (n,) of the ways from eyes (3,) or (n, 3) to points (n, 3) that are before the mirror, and which rays (n,) it turns
        back."""
        before = matmul(eye[..., :2], self.normal) - self.offset_m
        behind = self.offset_m - matmul(points[:, :2], self.normal)
        share = np.where((before > 0.0) & (behind > BEHIND_M), before / np.maximum(before + behind, 1e-9), 1.0)
        place = eye + share[:, None] * (points - eye)
        along = place[:, 0] * self.normal[1] - place[:, 1] * self.normal[0]
        inside = (along > self.span[0]) & (along < self.span[1]) & (place[:, 2] > self.heights[0]) & (place[:, 2] < self.heights[1])
        return np.asarray(share), np.asarray(inside & (share < 1.0))


@dataclass(frozen=True)
class UprightReadings:
    """Readings of upright surfaces of a storey: points (n, 3), normals (n, 3), the views (n,) that show them, and where all views are (v, 3);
    the keys (k,) of the voxels in which there are any, in order, and the number (n,) of each reading's."""

    points: F64
    normals: F64
    rows: I32
    eyes: F64
    keys: I64
    voxels: I32
    computed: dict[tuple[float, float], F64] = field(default_factory=dict)

    def along(self, direction: F64) -> F64:
        """Return the places (n,) of the readings along a direction (2,) on the plan. Faces have few: those of each are computed once."""
        key = float(direction[0]), float(direction[1])
        if key not in self.computed:
            self.computed[key] = matmul(self.points[:, :2], direction)
        return self.computed[key]


@dataclass(frozen=True)
class Crossing:
    """Numbers (n,) of readings whose rays cross a line on the plan: where along it (n,) and at which heights (n,), and what each counts for a mirror
    there (n,), less than 0 against it; which (n,) are of surfaces that face the line."""

    readings: I64
    along: F64
    height: F64
    evidence: F64
    facing: Bool

    @property
    def parts(self) -> tuple[F64, F64]:
        """Return the evidence (n,) of surfaces that face the line, and that of others."""
        return np.where(self.facing, self.evidence, 0.0), np.where(self.facing, 0.0, self.evidence)


def upright_readings(evidence: Evidence, storey: Storey) -> UprightReadings:
    """Select every EVERY-th reading of an upright surface."""
    chosen = np.nonzero(evidence.upright & (evidence.points[:, 2] > storey.bottom_m))[0][::EVERY]
    points, normals = evidence.points[chosen], evidence.normals[chosen]
    keys, voxels = np.unique(_voxels(points, normals), return_inverse=True)
    return UprightReadings(points, normals, evidence.rows[chosen], evidence.eyes, keys, voxels.astype(np.int32))


def mirrors_of(faces: list[Face], readings: UprightReadings, space: FreeSpace, storey: Storey) -> list[Mirror]:
    """Find the stretches of faces, high or not, and of their lines beside them, through which most readings that decide repeat what is before the
    face, and that nobody walked through."""
    found: list[Mirror] = []
    wide = round(WIDEST_M / CELL_M)
    for face in faces:
        framed = close_gaps(np.asarray(face.count[:, round(HIGH_M / LEVEL_M) :].sum(axis=1) >= LEAST_READINGS, np.bool_), wide)
        if longest_run(framed) * CELL_M >= LEAST_FACE_M:
            face = replace(face, start_m=face.start_m - WIDEST_M, count=np.pad(face.count, ((wide, wide), (0, 0))), tall=np.pad(face.tall, wide))
            framed = np.pad(framed, wide)
            crossing = _crossing(readings, space, storey, face, (face.start_m, face.start_m + CELL_M * len(framed)))
            found += _mirrors_on(face, framed, crossing, storey, readings.eyes)
    return found


def _mirrors_on(face: Face, framed: Bool, crossing: Crossing, storey: Storey, eyes: F64) -> list[Mirror]:
    """Find the mirrors on a face, of which columns (k,) are framed: read high up, or between such. Beside those only surfaces that face the mirror
    are evidence: a wall square to it goes on there. A mirror ends with the columns that decide, and reaches from the floor to the top of the face."""
    columns = np.clip(np.floor((crossing.along - face.start_m) / CELL_M).astype(int), 0, len(framed) - 1)
    top = storey.bottom_m + LEVEL_M * (1 + np.nonzero(face.count.any(axis=0))[0][-1])
    counted = (crossing.height < top) & (crossing.facing | framed[columns])
    crossed, facing, aside = (np.bincount(columns, counted * each, len(framed)) for each in (1.0, *crossing.parts))
    around = _together(*(sliding_sum(each, np.ones(BROAD)) for each in (facing, aside)))
    found = []
    for a, b in runs_of(np.asarray((sliding_sum(crossed, np.ones(BROAD)) > 0.0) & (around >= 0.0), np.bool_)):
        sure = a + np.nonzero(around[a:b] >= LEAST_WEIGHT)[0]
        a, b = (int(sure[0]), int(sure[-1]) + 1) if len(sure) else (a, a)
        span = face.start_m + CELL_M * a - RIM_M, face.start_m + CELL_M * b + RIM_M
        if (b - a) * CELL_M < NARROWEST_M or _together(facing[a:b].sum(), aside[a:b].sum()) < LEAST_WEIGHT or _is_walked_through(face, span, eyes):
            continue
        found.append(Mirror(face.normal, face.offset_m, span, (storey.bottom_m, top)))
    return found


def reflection_evidence(
    face: Face, span: tuple[float, float], heights: tuple[float, float], depth_m: float, readings: UprightReadings, space: FreeSpace, storey: Storey
) -> float:
    """Return what the readings through a part of a face of a wall that is `depth_m` thick count for a mirror there, less than 0 against it. Nobody
    walks through a mirror, and through an opening no rays pass what stands behind it."""
    if _is_walked_through(face, span, readings.eyes):
        return -float("inf")
    crossing = _crossing(readings, space, storey, face, span)
    within = (crossing.height > heights[0]) & (crossing.height < heights[1])
    blocked, rows = _are_blocked(crossing, readings, face, depth_m)[within], readings.rows[crossing.readings[within]]
    if 2 * blocked.sum() > len(blocked):
        return _by_view(blocked.astype(np.float64), rows)
    return float(_together(*(_by_view(each[within], rows) for each in crossing.parts)))


def _by_view(evidence: F64, rows: I32) -> float:
    """Add the evidence (n,) of views (n,), none of which decides alone: the readings of one err together."""
    return float(np.clip(np.bincount(rows, evidence), -LEAST_WEIGHT / 2.0, LEAST_WEIGHT / 2.0).sum())


def _are_blocked(crossing: Crossing, readings: UprightReadings, face: Face, depth_m: float) -> Bool:
    """Say of rays (n,) that cross a face of a wall if, within BLOCKED_M behind it and well before they end, they pass what stands behind the wall: it
    is read from there and faces away from it."""
    ends, away = readings.points[crossing.readings], readings.along(face.normal) - face.offset_m
    behind = (matmul(readings.eyes[:, :2], face.normal) < face.offset_m)[readings.rows] & (away < -depth_m - FIT_M)
    starts = np.column_stack([crossing.along[:, None] * face.along + face.offset_m * face.normal, crossing.height])
    length = np.linalg.norm(ends - starts, axis=1)
    normals = np.broadcast_to([*-face.normal, 0.0], ends.shape)
    out = np.zeros(len(ends), np.bool_)
    for step in np.arange(SAME_M, BLOCKED_M, SAME_M).tolist():
        places = starts + (ends - starts) * (step / length)[:, None]
        out |= (step < length - 2.0 * SAME_M) & _is_read(places, normals, readings, behind)
    return out


def _together(facing: F64 | float, aside: F64 | float) -> F64:
    """Add the evidence of surfaces that face a line and of walls square to it. These err together, reading by reading: all of them decide once, and
    not against a single reading of what faces the line."""
    return np.asarray(facing + np.clip(aside, -LEAST_WEIGHT, LEAST_WEIGHT), np.float64)


def _crossing(readings: UprightReadings, space: FreeSpace, storey: Storey, face: Face, span: tuple[float, float]) -> Crossing:
    """Compare the readings through a stretch of the line of a face, where that is not read itself, with what is known before it and behind it.

    One speaks for a mirror if its reflection is read before the face; against it if it is read from behind the face too, or if rays pass where its
    reflection is, above and below; neither if both or none is so, or if what is read there faces the other way: rays pass on both sides of a thin
    thing. A wall square to the face is no evidence unless the face reaches it: it may go on behind."""
    points, normals, eyes, normal = readings.points, readings.normals, readings.eyes, face.normal
    off, along_face = readings.along(normal) - face.offset_m, readings.along(face.along)
    away = matmul(eyes[:, :2], normal) - face.offset_m
    rays = np.nonzero((away > BEFORE_M)[readings.rows] & (off < -BEHIND_M))[0]
    rows = readings.rows[rays]
    share = away[rows] / (away[rows] - off[rays])
    along = (1.0 - share) * matmul(eyes[:, :2], face.along)[rows] + share * along_face[rays]
    inside = (along > span[0]) & (along < span[1])
    rays, rows, share, along = rays[inside], rows[inside], share[inside], along[inside]
    height = (1.0 - share) * eyes[rows, 2] + share * points[rays, 2]
    column, level = (np.floor(each).astype(int) for each in ((along - face.start_m) / CELL_M, (height - storey.bottom_m) / LEVEL_M))
    read = face.count[np.clip(column, 0, len(face.count) - 1), np.clip(level, 0, LEVELS - 1)] >= LEAST_READINGS
    inside = ~(read & (column >= 0) & (column < len(face.count)))
    rays, along, height, before = rays[inside], along[inside], height[inside], (away > 0.0)[readings.rows]
    in_front = before & (off > 0.0)
    facing = matmul(normals[rays, :2], normal)
    column = np.floor((along_face[rays] - face.start_m) / CELL_M).astype(int)
    reached = sliding_sum(np.pad(face.count.any(axis=1), REACH).astype(np.float64), np.ones(2 * REACH + 1)) > 0.0
    met = reached[np.clip(column + REACH, 0, len(reached) - 1)]
    evidence, judged = np.zeros(len(rays)), np.nonzero((np.abs(facing) > FACING) | met)[0]
    through, turned = points[rays[judged]], normals[rays[judged]]
    real = _is_read(through, turned, readings, ~before)
    reflected, turned = through.copy(), turned.copy()
    reflected[:, :2] -= 2.0 * off[rays[judged], None] * normal
    turned[:, :2] -= 2.0 * facing[judged, None] * normal
    repeats = _is_read(reflected, turned, readings, in_front)
    left = np.nonzero(~repeats & ~real)[0]
    left = left[~_is_read(reflected[left], -turned[left], readings, in_front)]
    around = [*(step * turned[left] for step in range(-2, 3)), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])]
    free = np.all([space.passed(reflected[left] + SAME_M * step, storey.bottom_m) for step in around], axis=0)
    against = real & ~repeats
    against[left[free]] = True
    evidence[judged] = np.where(against, -1.0, np.where(repeats & ~real, 1.0, 0.0))
    return Crossing(rays, along, height, evidence, np.abs(facing) > FACING)


def _is_walked_through(face: Face, span: tuple[float, float], eyes: F64) -> bool:
    """Say if the way of the camera (n, 3) crosses a stretch of the line of a face."""
    away, along = matmul(eyes[:, :2], face.normal) - face.offset_m, matmul(eyes[:, :2], face.along)
    crossed = away[:-1] * away[1:] < 0.0
    return bool((crossed & (along[:-1] > span[0] - ASIDE_M) & (along[:-1] < span[1] + ASIDE_M)).any())


def _voxels(points: F64, normals: F64) -> I64:
    """Return the keys (n,) of the voxels of points (n, 3), with the quarter that their normals (n, 3) look into."""
    quarter = np.floor((np.arctan2(normals[:, 1], normals[:, 0]) + np.pi / 4.0) / (np.pi / 2.0)).astype(np.int64) % 4
    cell = np.floor(points / SAME_M).astype(np.int64) + (1 << 15)
    return np.asarray(((cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2]) * 4 + quarter)


def _is_read(points: F64, normals: F64, readings: UprightReadings, chosen: Bool) -> Bool:
    """Say of points (n, 3) with normals (n, 3) if any of the chosen readings (m,) is in their voxel, or in one that shares a side with it."""
    known, keys = np.zeros(len(readings.keys), np.bool_), _voxels(points, normals)
    known[readings.voxels[chosen]] = True
    out, left = np.zeros(len(points), np.bool_), np.arange(len(points))
    for step in NEIGHBOURS:
        wanted = keys[left] + step
        at = np.minimum(np.searchsorted(readings.keys, wanted), len(known) - 1)
        there = (readings.keys[at] == wanted) & known[at]
        out[left[there]] = True
        left = left[~there]
    return out


def without_mirrors(evidence: Evidence, mirrors: list[Mirror]) -> Evidence:
    """Return the evidence with what mirrors show put where they are."""
    points, normals, information, views = evidence.points.copy(), evidence.normals.copy(), evidence.information.copy(), list(evidence.views)
    for mirror in mirrors:
        behind = np.nonzero(matmul(points[:, :2], mirror.normal) < mirror.offset_m)[0]
        rays = behind[(matmul(evidence.eyes[:, :2], mirror.normal) > mirror.offset_m)[evidence.rows[behind]]]
        eyes = evidence.eyes[evidence.rows[rays]]
        share, inside = mirror.crossing(eyes, points[rays])
        turned = rays[inside]
        points[turned] = eyes[inside] + share[inside, None] * (points[turned] - eyes[inside])
        normals[turned] = [*mirror.normal, 0.0]
        information[turned] *= MOVED
        for row in np.unique(evidence.rows[turned]):
            views[row] = _view_without(views[row], evidence.poses[row], mirror)
    return replace(evidence, points=points, normals=normals, information=information, views=views)


def _view_without(view: KeyframeView, T: F64, mirror: Mirror) -> KeyframeView:
    """Return a view whose rays end at a mirror."""
    r, c = np.nonzero(view.depth_m > 0.0)
    points = view.camera.back_project(np.stack([c, r], axis=1), view.depth_m[r, c].astype(np.float64))
    share, turned = mirror.crossing(T[:3, 3], matmul(points, T[:3, :3].T) + T[:3, 3])
    depth = view.depth_m.copy()
    depth[r[turned], c[turned]] = (share * view.depth_m[r, c])[turned]
    return replace(view, depth_m=depth)
