"""Tall furniture as against walls: the probability that a stretch of a face is a wall, by the heights at which views read it and what is behind."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.linalg import inv, matmul
from trihedron.pipeline.core.types import F64
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import Face, longest_run, runs_of
from trihedron.plugins.building.free_space import CELL_M, LEVEL_M, FreeSpace
from trihedron.plugins.building.free_space_kernels import LEVELS
from trihedron.plugins.building.jogs import SHORT_M, THICKEST_M
from trihedron.plugins.building.levels import Storey
from trihedron.plugins.building.looks import looks_at

FURNITURE_M = (1.8, 2.5)  # heights of what may be taken for a wall, all as likely
BELOW_CEILING_M = 0.2  # and no nearer to it
LEAST_RANGE_M = 0.3  # of those heights, below a low ceiling
LEAST_LOOKS = 2
LEAST_LEVELS = 4  # at which views look through below what is read: under a lintel, a beam, the edge of a slab
LEAST_SHARE = 0.15  # of a stretch's columns, by which its height is judged, and from which it was looked over
LONG_M = 0.4  # shorter stretches are judged by half of their columns
PRIORS = {"backed": 0.95, "behind": 0.25, "narrow": 0.6, "alone": 0.75}  # probabilities of a wall before its height is known: `wall_prior`
MISTAKEN = 0.02  # how often a view is thought to look over a wall
COLUMN_M = (0.3, 0.45)  # widths of columns; furniture as high as a man is seldom as narrow
KNOWN = 0.8  # probability, without what is behind, from which a stretch is a wall by which others are judged
DEEPEST_M, USUAL_DEPTH_M, USUAL_WALL_M = 1.0, 0.6, 0.1  # of furniture, of a wall
THIN_M = 0.2  # what is nearer to a wall that is seen on both its sides, a curtain or a pilaster, is no wall
BESIDE_M = 1.5  # from the end of a front to the strip of wall beside it
STRIP_M = 0.15  # least strip of wall that is seen behind the line of a front
ASIDE_M = 1.6  # between stretches of one wall


@dataclass(frozen=True)
class Doubt:
    """A stretch of a face that may be furniture: its ends on the plan (2, 2), how far behind it the wall then is, and the probability that it is a
    wall; a plan has it as one from 0.5."""

    ends: F64
    normal: F64
    depth_m: float
    wall_probability: float


@dataclass(frozen=True)
class Stretch:
    """Columns `begin` to `end` of a face, the height up to which they were read, if views looked over them, and if it hangs: views look through below
    what is read of most columns."""

    begin: int
    end: int
    height_m: float
    over: bool
    hangs: bool = False


def remove_furniture(
    faces: list[Face], evidence: Evidence, storey: Storey, space: FreeSpace, least_m: float
) -> tuple[list[Face], list[Doubt]]:  # fmt: skip
    """Return the faces without the stretches that are rather furniture than walls, and how certain that is of each stretch. What stands behind those
    removed is marked in `space`; a face of which less than `least_m` is left is none unless it reaches higher than
    furniture or is as wide as a column."""
    highest = min(FURNITURE_M[1], storey.ceiling_m - storey.bottom_m - BELOW_CEILING_M) if np.isfinite(storey.ceiling_m) else FURNITURE_M[1]
    inverses = [inv(T) for T in evidence.poses]
    stretches = [_stretches(face, evidence, storey, inverses) for face in faces]
    faces = [_with_known(face, found, highest, faces) for face, found in zip(faces, stretches)]
    kept, doubts = [], []
    for face, found in zip(faces, stretches):
        tall, counts = face.tall.copy(), False
        for one in found:
            depth = _depth_to_wall(face, one, faces)
            probability = wall_probability(one, highest, wall_prior(face, one, faces, depth))
            if depth is not None and depth < THIN_M and _wall_on_both_sides(face, one, depth, faces):
                probability = 0.0
            deep = USUAL_DEPTH_M if depth is None else depth
            if probability < 0.5:
                tall[one.begin : one.end] = False
                space.furnish(_footprint(face, one, deep))
            wide_m = (one.end - one.begin) * CELL_M + 1e-9
            counts |= (probability >= KNOWN and one.height_m >= highest and wide_m >= SHORT_M) or (probability >= 0.5 and wide_m >= COLUMN_M[0])
            ends = (face.start_m + CELL_M * np.array([[one.begin], [one.end]])) * face.along + face.offset_m * face.normal
            doubts.append(Doubt(ends, face.normal, deep, probability))
        if counts or longest_run(tall) * CELL_M >= least_m:
            kept.append(replace(face, tall=tall))
    return kept, [doubt for doubt in doubts if 0.0 < doubt.wall_probability < 1.0]


def _stretches(face: Face, evidence: Evidence, storey: Storey, inverses: list[F64]) -> list[Stretch]:
    """Compare the heights at which views read the stretches of a face with those at which they read what is behind its line."""
    looks, level = looks_at(face, evidence, storey, inverses), np.arange(LEVELS)
    below = (level + 1.0) * LEVEL_M < (storey.ceiling_m if np.isfinite(storey.ceiling_m) else storey.next_m) - storey.bottom_m
    on, beyond = (looks.on >= LEAST_LOOKS) & below, (looks.beyond >= LEAST_LOOKS) & below
    top = np.where(on.any(axis=1), LEVELS - np.argmax(on[:, ::-1], axis=1), 0)  # levels up to the highest that was read
    over = (beyond & (level >= top[:, None])).any(axis=1) & (top * LEVEL_M >= FURNITURE_M[0] - 0.5)
    under = (beyond & ~on & (level < top[:, None])).sum(axis=1) >= LEAST_LEVELS
    found = []
    for a, b in runs_of(face.tall):
        share = LEAST_SHARE if (b - a) * CELL_M >= LONG_M else 0.5
        height = (float(np.quantile(top[a:b], 1.0 - share)) - 0.5) * LEVEL_M  # the middle of a level
        found.append(Stretch(a, b, height, bool(over[a:b].mean() >= LEAST_SHARE), bool(under[a:b].mean() > 0.5)))
    return found


def wall_probability(one: Stretch, highest: float, prior: float) -> float:
    """Return the probability that a stretch is a wall: furniture would have to be as high as it was read, nobody looks over a wall; none hangs."""
    if one.hangs:
        return 0.0
    lowest = min(FURNITURE_M[0], highest - LEAST_RANGE_M)
    as_high = float(np.clip((highest - one.height_m) / (highest - lowest), 0.0, 1.0))
    wall, furniture = prior * (MISTAKEN if one.over else 1.0), (1.0 - prior) * as_high
    return wall / (wall + furniture) if wall + furniture > 0.0 else 0.0


def wall_prior(face: Face, one: Stretch, faces: list[Face], depth: float | None) -> float:
    """Return the probability of a wall where its other face is close behind or it continues one, where a wall is seen behind, and elsewhere."""
    if _is_backed(face, one, faces, depth) or _continues(face, one):
        return PRIORS["backed"]
    if depth is None:
        return PRIORS["alone"]
    return PRIORS["narrow" if COLUMN_M[0] - 1e-9 <= (one.end - one.begin) * CELL_M <= COLUMN_M[1] + 1e-9 else "behind"]


def _with_known(face: Face, found: list[Stretch], highest: float, faces: list[Face]) -> Face:
    """Mark the stretches of a face that are walls for certain, first those by their height, then those that continue one or have another face."""
    known = np.zeros(len(face.tall), np.bool_)
    for one in found:
        known[one.begin : one.end] = wall_probability(one, highest, 0.5) >= KNOWN
    face = replace(face, known=known)
    more = known.copy()
    for one in found:
        long = (one.end - one.begin) * CELL_M >= LONG_M
        if long and (_is_backed(face, one, faces) or _continues(face, one)):
            more[one.begin : one.end] |= wall_probability(one, highest, PRIORS["backed"]) >= KNOWN
    return replace(face, known=more)


def _footprint(face: Face, one: Stretch, depth: float) -> F64:
    """Return points (n, 2) denser than cells behind a stretch of a face."""
    along = face.start_m + CELL_M * (np.arange(2 * one.begin, 2 * one.end) + 0.5) / 2.0
    away = face.offset_m - CELL_M / 2.0 * np.arange(int(2.0 * depth / CELL_M) + 1)
    return np.asarray((along[:, None, None] * face.along + away[None, :, None] * face.normal).reshape(-1, 2))


def _continues(face: Face, one: Stretch) -> bool:
    """Say if there is more beside a stretch, on its line, that is a wall for certain."""
    aside = round(ASIDE_M / CELL_M)
    return bool(face.known[max(one.begin - aside, 0) : one.begin].any() or face.known[one.end : one.end + aside].any())


def _is_backed(face: Face, one: Stretch, faces: list[Face], depth: float | None = None) -> bool:
    """Say if another face looks away from a stretch, a wall's thickness behind it; none that is behind the wall at that depth, whose it is."""
    begin, end = face.start_m + CELL_M * one.begin, face.start_m + CELL_M * one.end
    return any(
        float(matmul(other.normal, face.normal)) < -0.999
        and 0.0 < face.offset_m + other.offset_m < min(THICKEST_M, np.inf if depth is None else depth)
        and other.share(-end, -begin, other.tall) > 0.3
        for other in faces
    )


def _depth_to_wall(face: Face, one: Stretch, faces: list[Face]) -> float | None:
    """Return how far behind the line of a stretch there is a wall: a strip of it is seen beside or above the stretch, or its other side, which is
    farther behind than walls are thick; None where there is none."""
    begin, end = face.start_m + CELL_M * one.begin, face.start_m + CELL_M * one.end
    strips, backs = list[float](), list[float]()
    for other in faces:
        same = float(matmul(other.normal, face.normal))
        depth = face.offset_m - np.sign(same) * other.offset_m
        if other is face or abs(same) < 0.999:
            continue
        if same > 0.0 and 0.03 < depth < DEEPEST_M:
            first, stop = other.column_at(begin - BESIDE_M), other.column_at(end + BESIDE_M)
            if other.known[max(first, 0) : max(stop, 0)].sum() * CELL_M >= STRIP_M:
                strips.append(depth)
        elif same < 0.0 and THICKEST_M < depth < DEEPEST_M and other.share(-end, -begin, other.known) > 0.5:
            backs.append(depth - USUAL_WALL_M)
    return min(strips or backs, default=None)


def _wall_on_both_sides(face: Face, one: Stretch, depth: float, faces: list[Face]) -> bool:
    """Say if the wall so far behind a stretch is seen on both its sides."""
    width, begin, end = round(2.0 * STRIP_M / CELL_M), face.start_m + CELL_M * one.begin, face.start_m + CELL_M * one.end
    for other in faces:
        if float(matmul(other.normal, face.normal)) > 0.999 and abs(face.offset_m - other.offset_m - depth) < 1e-9:
            first, stop = other.column_at(begin), other.column_at(end)
            return bool(other.tall[max(first - width, 0) : max(first, 0)].any() and other.tall[max(stop, 0) : max(stop + width, 0)].any())
    return False
