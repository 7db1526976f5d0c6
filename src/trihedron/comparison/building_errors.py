"""Errors of a floor plan against the true one of a simulated building."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trihedron.comparison.floorplan_scores import Score, floorplan_scores
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.plan_areas import area_interval

if TYPE_CHECKING:
    from trihedron.datasets.simulation.true_plan import TruePlan
    from trihedron.pipeline.core.types import F64, Bool, Building

FOUND_IOU, DOOR_M, EDGE_M, LEAST_EDGE_M = 0.5, 0.3, 0.15, 0.5


def plan_errors_of_run(run: Path, plugin: str | None = None, beside: Path | None = None) -> dict[str, float]:
    """Return the figures of a run folder of a synthetic scene; its plan as recorded, or made by a plugin, with the CPU time. The trajectory is that
    of the folder `beside` where the run has none. Raises DataError."""
    from trihedron.comparison.surface_errors import alignment, trajectory_in
    from trihedron.pipeline.app.recorded_run import composed_run
    from trihedron.pipeline.core.config import make_plugin
    from trihedron.pipeline.core.registry import load_plugins
    from trihedron.pipeline.record.reader import Recording
    from trihedron.recorded_building import building_of, fold_recording

    load_plugins()
    recording = Recording(run / "run.mcap")
    dataset = make_plugin("dataset", composed_run(recording).dataset)
    if not hasattr(dataset, "plans"):
        raise DataError(str(run), "is of a data set without an exact plan", "judge a run of dataset=synthetic")
    T = alignment(trajectory_in(run, beside or run), dataset.truth())
    if plugin is None:
        return plan_errors(building_of(recording), T, dataset.plans())
    fold, state, final = fold_recording(recording, plugin)
    began = time.process_time()
    building = fold.finish(state, final)
    spent = time.process_time() - began
    return plan_errors(building, T, dataset.plans()) | {"final_s": spent}


def plan_errors(building: Building, T_truth_world: F64, plans: list[TruePlan]) -> dict[str, float]:
    """Return the figures of a plan, each storey by the true one that is nearest in height: NaN where there is nothing to judge."""
    import shapely

    T = T_truth_world @ building.T_world_building
    truth = [(storey, room, shapely.Polygon(room[0], room[1:])) for storey, plan in enumerate(plans) for room in plan.rooms]
    mine, at = [_polygon(building, room, T) for room in range(len(building.areas_m2))], storeys_at(building, T, plans)
    overlap = np.array([[_iou(a, b) * (at[building.room_storeys[k]] == storey) for storey, _, b in truth] for k, a in enumerate(mine)])
    overlap = overlap.reshape(len(mine), len(truth))
    pairs = [(room, int(np.argmax(overlap[room]))) for room in range(len(mine)) if overlap[room].max(initial=0.0) > FOUND_IOU]
    areas = np.array([mine[a].area - truth[b][2].area for a, b in pairs])
    walls = [error for a, b in pairs for error in _edges(building, a, truth[b][1], T)]
    heights = _heights(building, at, plans)
    found = [_doors(building, plan, T, building.wall_storeys[building.opening_walls] == storey) for storey, plan in _storey_plan_pairs(at, plans)]
    scores = _scores(building, mine, at, truth)
    doors, false, doorways = sum(hits for hits, _ in found), sum(wrong for _, wrong in found), sum(len(plan.doorways) for plan in plans)
    within = [low <= building.areas_m2[a] - error <= high for error, (a, _) in zip(areas, pairs) for low, high in [area_interval(building, a)]]
    honest = list(within)
    honest += [abs(off) < 1.96 * sigma for off, _, sigma in walls if np.isfinite(sigma)]
    honest += [abs(error) < 1.96 * sigma for error, sigma in heights]
    return {
        "wall_m": _median([abs(off) for off, *_ in walls]),
        "angle_deg": _median([abs(angle) for _, angle, _ in walls]),
        "iou": _median([overlap[a, b] for a, b in pairs]),
        **{f"{name}_f1": score.f1 for name, score in scores.items()},
        "corner_precision": scores["corner"].precision,
        "corner_recall": scores["corner"].recall,
        "room_recall": len({b for _, b in pairs}) / len(truth),
        "room_precision": len(pairs) / len(mine) if mine else float("nan"),
        "door_recall": doors / doorways if doorways else float("nan"),
        "door_precision": doors / (doors + false) if doors + false else float("nan"),
        "false_openings": float(
            sum(
                _false_openings(building, plan, T, building.wall_storeys[building.opening_walls] == storey)
                for storey, plan in _storey_plan_pairs(at, plans)
            )
        ),
        "area_error": _median([abs(error) / truth[b][2].area for error, (_, b) in zip(areas, pairs)]),
        "area_within": float(np.mean(within)) if within else float("nan"),
        "height_m": _median([abs(error) for error, _ in heights]),
        "honest": float(np.mean(honest)) if honest else float("nan"),
    }


def _scores(building: Building, rooms: list[Any], at: list[int], truth: list[tuple[int, Any, Any]]) -> dict[str, Score]:
    """Return the scores of rooms, corners and angles over all storeys."""
    found = []
    for storey in sorted({storey for storey, *_ in truth}):
        mine = [room for k, room in enumerate(rooms) if at[building.room_storeys[k]] == storey]
        found.append(floorplan_scores(mine, [polygon for other, _, polygon in truth if other == storey]))
    return {name: sum((one[name] for one in found), Score(0, 0, 0)) for name in ("room", "corner", "angle")}


def storeys_at(building: Building, T: F64, plans: list[TruePlan]) -> list[int]:
    """Return the true storey nearest to each of a building."""
    floors = [low if np.isfinite(low) else high - 2.5 for low, high in building.storeys + T[2, 3]]
    return [int(np.argmin([abs(floor - plan.floor_m) for plan in plans])) for floor in floors]


def _storey_plan_pairs(at: list[int], plans: list[TruePlan]) -> list[tuple[int, TruePlan]]:
    return [(storey, plans[true]) for storey, true in enumerate(at)]


def _heights(building: Building, at: list[int], plans: list[TruePlan]) -> list[tuple[float, float]]:
    """Return (error, standard deviation) of the heights of storeys, and of floors above the lowest."""
    pairs = list(zip(building.storeys, building.storey_covariance, (plans[k] for k in at)))
    found = [(high - low - (true.ceiling_m - true.floor_m), float(np.sqrt(np.trace(covariance)))) for (low, high), covariance, true in pairs]
    for (low, _), covariance, true in pairs[1:]:
        (first, _), below, lowest = pairs[0]
        found.append((low - first - (true.floor_m - lowest.floor_m), float(np.sqrt(covariance[0, 0] + below[0, 0]))))
    return [(float(error), sigma) for error, sigma in found if np.isfinite(error) and np.isfinite(sigma)]


def _median(values: list[Any]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _transform_to_truth(points: F64, T: F64) -> F64:
    """Return points (n, 2) of the building's plan on that of the truth."""
    return np.asarray(points @ T[:2, :2].T + T[:2, 3])


def _polygon(building: Building, room: int, T: F64) -> Any:
    import shapely

    rings = [_transform_to_truth(building.corners_m[a:b], T) for of, a, b in building.loops if of == room]
    return shapely.make_valid(shapely.Polygon(rings[0], rings[1:]))


def _iou(a: Any, b: Any) -> float:
    return float(a.intersection(b).area / a.union(b).area)


def _edges(building: Building, room: int, rings: list[F64], T: F64) -> list[tuple[float, float, float]]:
    """Return (offset in metres, angle in degrees, standard deviation of the offset; NaN where the face is another room's) of a room's edges."""
    ends = [(p, q) for ring in rings for p, q in zip(ring, np.roll(ring, -1, axis=0))]
    found = []
    for of, a, b in building.loops:
        corners = _transform_to_truth(building.corners_m[a:b], T)
        for p, q, wall in zip(corners, np.roll(corners, -1, axis=0), building.corner_walls[a:b]) if of == room else ():
            if wall < 0 or np.linalg.norm(q - p) < LEAST_EDGE_M:
                continue
            along, middle = (q - p) / np.linalg.norm(q - p), (p + q) / 2.0
            near = [(_off(middle, *end), _angle(along, *end)) for end in ends if _beside(middle, *end)]
            near = [item for item in near if abs(item[0]) < EDGE_M and abs(item[1]) < 10.0]
            if near:
                face = _transform_to_truth(building.walls_m[wall], T)
                own = abs(_off(middle, face[0], face[1])) < 1e-6
                sigma = float(np.sqrt(building.wall_covariance[wall, 0, 0])) if own else float("nan")
                found.append((*min(near, key=lambda item: abs(item[0])), sigma))
    return found


def _off(point: F64, a: F64, b: F64) -> float:
    along = (b - a) / np.linalg.norm(b - a)
    return float((point - a) @ np.array([-along[1], along[0]]))


def _beside(point: F64, a: F64, b: F64) -> bool:
    length = float(np.linalg.norm(b - a))
    return 0.0 <= float((point - a) @ (b - a)) / length <= length


def _angle(along: F64, a: F64, b: F64) -> float:
    """Return the angle between an edge and a true one in degrees, both taken as going the same way round the room."""
    other = (b - a) / np.linalg.norm(b - a)
    return float(np.degrees(np.arctan2(along[0] * other[1] - along[1] * other[0], along @ other)))


def _doors(building: Building, plan: TruePlan, T: F64, chosen: Bool) -> tuple[int, int]:
    """Return the number of true doorways that were found among the chosen openings, and of doors and passages that are none."""
    from trihedron.pipeline.core.types import OPENING_KINDS

    middles = _middles(building, T, chosen & (building.opening_kinds != OPENING_KINDS.index("window")))
    hits = {k for k, door in enumerate(plan.doorways) for middle in middles if np.linalg.norm(door.middle - middle) < DOOR_M}
    return len(hits), sum(all(np.linalg.norm(door.middle - middle) >= DOOR_M for door in plan.doorways) for middle in middles)


def _false_openings(building: Building, plan: TruePlan, T: F64, chosen: Bool) -> int:
    """Return the number of chosen openings of any kind that are neither a true doorway nor a true window."""
    true = [*plan.doorways, *plan.windows]
    return sum(all(np.linalg.norm(gap.middle - middle) >= DOOR_M for gap in true) for middle in _middles(building, T, chosen))


def _middles(building: Building, T: F64, chosen: Bool) -> list[F64]:
    """Return the middles (2,) of chosen openings on the plan of the truth."""
    found = []
    for wall, span in zip(building.opening_walls[chosen], building.spans_m[chosen]):
        start, end = _transform_to_truth(building.walls_m[wall], T)
        found.append(start + (end - start) / np.linalg.norm(end - start) * span.mean())
    return found
