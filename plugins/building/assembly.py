"""The plan of all storeys as the slot's value."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import ELEMENTS, F64, I32, OPENING_KINDS, SUPPORTS, Building, Map
from trihedron.plugins.building.edges import FIT_M
from trihedron.plugins.building.evidence import LEVEL_DEG, SCALE, Evidence
from trihedron.plugins.building.faces import Face
from trihedron.plugins.building.free_space import CELL_M
from trihedron.plugins.building.levels import LEVEL_NEAR_M, Storey, at_level
from trihedron.plugins.building.openings import OpeningPlan
from trihedron.plugins.building.rooms import RoomPlan
from trihedron.plugins.building.views import BuildingState
from trihedron.plugins.building.walls import WallPlan
from trihedron.plugins.shared.voxel_hash_kernels import I64

AT_END = 4  # cells of an end of a wall, of which those at the wall that meets it there are seen with that


@dataclass
class StoreyPlan:
    """Elements found in one storey."""

    storey: Storey
    rooms: list[RoomPlan]
    walls: list[WallPlan]
    openings: list[OpeningPlan]
    faces: list[Face]
    remark: str = ""


@dataclass(frozen=True)
class MapPlanes:
    """Planes of a map in the building's frame: ids (p,), normals (p, 3), offsets (p,) and the samples (s, 3) of each."""

    ids: I64
    normals: F64
    offsets_m: F64
    samples_m: list[F64]


def assemble_building(state: BuildingState, evidence: Evidence, plans: list[StoreyPlan], map: Map | None) -> Building:
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
    doubts: list[tuple[int, float, float]] = []
    used: set[int] = set()
    known = _map_planes(evidence, map)
    for level, plan in enumerate(plans):
        planes_of = [_planes_of_wall(wall, known) for wall in plan.walls]
        used.update(chain(*planes_of))
        first_wall, first_room = len(walls), len(areas)
        support += _supports("storey", level, *_level_support(plan.storey, evidence, known), evidence)
        for number, wall in enumerate(plan.walls):
            edge = wall.edge
            foot = edge.offset_m * edge.normal
            walls.append([foot + t * edge.along for t in wall.span])
            wall_storeys.append(level)
            thickness.append(wall.thickness_m)
            angle = edge.angle_sigma
            wall_covariance.append(np.diag([edge.sigma_m**2 + edge.drift_m2 + (SCALE * edge.offset_m) ** 2, wall.thickness_sigma_m**2, angle**2]))
            unseen += [(first_wall + number, a - wall.span[0], b - wall.span[0]) for a, b in _unseen_stretches(wall, plan.openings, number)]
            rows = np.unique(np.concatenate([e.views for _, e in wall.edges]))
            support += _supports("wall", first_wall + number, planes_of[number], rows, evidence)
        for number, room in enumerate(plan.rooms):
            rows = np.unique(np.concatenate([edge.views for loop in room.loops for edge in loop]))
            support += _supports("room", first_room + number, [], rows, evidence)
            for loop in room.loops:
                loops.append((first_room + number, len(corners), len(corners) + len(loop)))
                corners += [edge.begin for edge in loop]
                edge_sigmas += [edge.sigma_m for edge in loop]
                corner_walls += [first_wall + edge.wall if edge.wall >= 0 else -1 for edge in loop]
            doubts += [(first_room + number, *doubt) for doubt in room.doubts]
            area, variance = _area(room)
            areas.append(area)
            variances.append(variance)
            room_storeys.append(level)
            closed.append(all(edge.wall >= 0 for loop in room.loops for edge in loop))
        for opening in plan.openings:
            support += _supports("opening", len(spans), planes_of[opening.wall], opening.views, evidence)
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
        np.array(opening_covariance).reshape(-1, 4, 4), np.array(opening_rooms, np.int32).reshape(-1, 2), _furniture(known, used, plans),
        np.array(support, np.int32).reshape(-1, 4), np.array(doubts, np.float64).reshape(-1, 3),
    )  # fmt: skip


def empty_building(state: BuildingState, note: str, T_world_building: F64 | None = None) -> Building:
    """Return the plan without elements, with the reason."""
    return Building.empty(state.index, state.stamp_ns, note, T_world_building)


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


def _unseen_stretches(wall: WallPlan, openings: list[OpeningPlan], number: int) -> list[tuple[float, float]]:
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


def _planes_of_wall(wall: WallPlan, known: MapPlanes) -> list[int]:
    """Return the ids of the map's living planes that lie on either face of a wall."""
    edge, depth, found = wall.edge, wall.thickness_m, []
    facing = matmul(known.normals[:, :2], edge.normal)
    for row in np.nonzero(np.abs(facing) > 0.995)[0]:
        seen = known.samples_m[row]
        if len(seen) == 0:
            continue
        off, t = matmul(seen[:, :2], edge.normal) - edge.offset_m, matmul(seen[:, :2], edge.along)
        between = ((t > wall.span[0] - 0.1) & (t < wall.span[1] + 0.1)).mean() > 0.5
        near = np.abs(off).mean() < FIT_M if facing[row] > 0.0 else np.isfinite(depth) and np.abs(off + depth).mean() < FIT_M
        if between and near:
            found.append(int(known.ids[row]))
    return found


def _level_support(storey: Storey, evidence: Evidence, known: MapPlanes) -> tuple[list[int], I32]:
    """Return the ids of the map's living planes at a storey's floor or ceiling, and the views that show either."""
    rows, planes = np.zeros(0, np.int32), list[int]()
    for height, facing in ((storey.floor_m, 1.0), (storey.ceiling_m, -1.0)):
        if np.isfinite(height):
            rows = np.union1d(rows, evidence.rows[at_level(evidence, height, facing)])
        level = known.normals[:, 2] * facing > np.cos(np.radians(LEVEL_DEG))
        planes += known.ids[level & (np.abs(known.offsets_m + height * known.normals[:, 2]) < LEVEL_NEAR_M)].tolist()
    return planes, rows.astype(np.int32)


def _map_planes(evidence: Evidence, map: Map | None) -> MapPlanes:
    """Return the map's living planes in the building's frame."""
    if map is None or len(map.planes) == 0:
        return MapPlanes(np.empty(0, np.int64), np.empty((0, 3)), np.empty(0), [])
    ids = np.nonzero(map.planes.rows("alive", np.arange(len(map.planes))))[0]
    R, t = evidence.T_world_building[:3, :3], evidence.T_world_building[:3, 3]
    coefficients = map.planes.rows("coefficients", ids)
    samples = matmul(np.asarray(map.planes.rows("samples_m", ids), np.float64) - t, R)
    taken = [each[finite] for each, finite in zip(samples, np.isfinite(samples).all(axis=2))]  # NaN where a plane has fewer
    return MapPlanes(ids, matmul(coefficients[:, :3], R), coefficients[:, 3] + matmul(coefficients[:, :3], t), taken)


def _furniture(known: MapPlanes, used: set[int], plans: list[StoreyPlan]) -> I32:
    """Return the ids of the map's planes that are neither a wall's nor a floor nor a ceiling."""
    levels = [height for plan in plans for height in (plan.storey.floor_m, plan.storey.ceiling_m)]
    found = []
    for number, normal, offset in zip(known.ids, known.normals, known.offsets_m):
        height = -offset / normal[2] if abs(normal[2]) > 0.9 else float("nan")
        if number not in used and not any(abs(height - level) < 0.1 for level in levels):
            found.append(int(number))
    return np.array(found, np.int32)
