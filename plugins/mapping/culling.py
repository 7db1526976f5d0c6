"""Culling: landmarks that are not matched again, and keyframes that are redundant or repeat an older view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Map, Matches, Table
from trihedron.plugins.mapping.covisibility_graph import (
    WEIGHTS,
    covisible_keyframes,
    keyframes_of,
    living_keyframes,
    newest_keyframes,
    observed_by,
    observed_by_each,
)
from trihedron.plugins.mapping.landmark_kernels import count_redundant
from trihedron.plugins.mapping.landmark_kinds import LINE, PLANE, POINT, LandmarkKind, landmarks_of, observations_of, with_tables
from trihedron.plugins.mapping.landmarks import isin, newest_first, remove_rows, union

RETAINED = 4  # newest keyframes that are never redundant yet: the newest one's landmarks are still on trial


def cull_landmarks(map: Map, keyframe: int, matches: Matches | None, planes: I32, trial: int, min_found: float) -> Map:
    """Remove points and lines that were expected by this keyframe or created `trial` keyframes ago, and `planes` expected by it, whose found ratio is
    too low. The cost depends on the view, not on the size of the map."""
    young = np.array([keyframe - trial], np.int32) if keyframe >= trial else np.empty(0, np.int32)
    visible = (matches.visible_points, matches.visible_lines) if matches is not None else (young[:0], young[:0])
    tables = landmarks_of(map)
    for kind, expected in zip((POINT, LINE), visible):
        table, ids = tables[kind], union(observed_by(map, young, kind), expected)
        found, seen, first = table.columns_at(ids, "found", "visible", "first")
        seldom = (found < min_found * seen) | ((first == keyframe - trial) & (found < trial) & (seen >= trial))
        tables[kind] = remove_rows(table, ids[seldom])
    found, seen = map.planes.columns_at(planes, "found", "visible")
    tables[PLANE] = remove_rows(map.planes, planes[found < min_found * seen])
    return with_tables(map, tables)


def cull_redundant_keyframe(map: Map, others: int, share: float) -> Map:
    """Remove the most redundant keyframe near the newest: more than `share` of its landmarks are observed as well by at least `others` further ones
    (ORB-SLAM: 90 % by three), weighted as in covisibility. The first keyframe, the world's origin, and the newest few are retained."""
    newest = newest_keyframes(map, RETAINED)
    around = covisible_keyframes(map, newest, 2 * others) if len(newest) else newest
    around = np.sort(around[around > 0])
    shares = _redundancies(map, around, others) if len(around) else np.zeros(1)
    if shares.max() <= share:
        return map
    return remove_keyframe(map, int(around[np.argmax(shares)]))


def cull_repeated_keyframe(map: Map, shift_m: float, turn_deg: float, share: float) -> Map:
    """Remove the keyframe that has just left the newest few if it repeats the view of an older one: within `shift_m` and `turn_deg` of it, without a
    plane of its own, and with at least `share` of its landmarks, weighted as in covisibility, observed from there. So a room that is revisited again
    and again has as many keyframes as after the first visit, and they constrain it."""
    newest = newest_keyframes(map, RETAINED + 1)
    if len(newest) <= RETAINED or newest[0] == 0:
        return map
    keyframe = newest[:1]
    older = keyframes_of(map, int(map.keyframes.rows("submap", keyframe)[0]))
    older = older[older < keyframe[0]]
    T = matmul(invert(map.keyframes.rows("T_world_camera", keyframe)), map.keyframes.rows("T_world_camera", older))
    cosine = 0.5 * (np.trace(T[:, :3, :3], axis1=1, axis2=2) - 1.0)
    near = older[(np.linalg.norm(T[:, :3, 3], axis=1) <= shift_m) & (cosine >= np.cos(np.radians(turn_deg)))]
    seen, known = 0, 0
    for kind, weight in WEIGHTS.items():
        own = observed_by(map, keyframe, kind)
        seen += weight * len(own)
        known += weight * int(np.count_nonzero(isin(own, observed_by(map, near, kind))))
    planes = observed_by(map, keyframe, PLANE)
    if not len(near) or known < share * seen or not isin(planes, observed_by(map, older, PLANE)).all():
        return map
    return remove_keyframe(map, int(keyframe[0]))


def _redundancies(map: Map, keyframes: I32, others: int) -> F64:
    """(n,) weighted share of each keyframe's living landmarks that at least so many other living keyframes observed from as near."""
    seen, redundant = np.zeros(len(keyframes)), np.zeros(len(keyframes))
    for kind, table in landmarks_of(map).items():
        ids, observed, ends = observed_by_each(map, keyframes, kind)
        observers, centres = table.rows("observers", ids), _centres(table, kind, ids)
        rows = union(observers[observers >= 0], keyframes)
        known, alive = map.keyframes.columns_at(rows, "T_world_camera", "alive")
        counts = count_redundant(observed, ends, keyframes, observers, centres, rows, known, alive, others)
        seen += WEIGHTS[kind] * counts[0]
        redundant += WEIGHTS[kind] * counts[1]
    return redundant / np.maximum(seen, 1.0)


def _centres(table: Table, kind: LandmarkKind, ids: I32) -> F64:
    """(n, 3) centres of landmarks."""
    if kind == POINT:
        return table.rows("position_m", ids)
    if kind == LINE:
        return np.asarray(table.rows("endpoints_m", ids).mean(axis=1), np.float64)
    samples = table.rows("samples_m", ids).astype(np.float64)
    known = np.isfinite(samples).all(axis=2, keepdims=True)
    return np.asarray(np.where(known, samples, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1), np.float64)


def remove_keyframe(map: Map, keyframe: int) -> Map:
    """Remove a keyframe from every window. Its row remains, for poses relative to it; its observations are freed. Points and lines without another
    observer are removed too, since no window would contain them; planes remain, for the surface."""
    row = np.array([keyframe], np.int32)
    tables = landmarks_of(map)
    for kind, table in tables.items():
        ids = observed_by(map, row, kind)
        observers = table.rows("observers", ids)
        observers = newest_first(np.where(observers == keyframe, -1, observers))
        table = table.updated(ids, observers=observers)
        tables[kind] = remove_rows(table, ids[observers[:, 0] < 0]) if kind != PLANE else table
    nothing = {kind.span_column: np.zeros((1, 2), np.int32) for kind in tables}
    return replace(with_tables(map, tables), keyframes=remove_rows(map.keyframes.updated(row, **nothing), row))


def free_dead_rows(map: Map) -> Map:
    """Free the chunks of the tables without a living landmark, or without an observation of a living keyframe; rows keep their numbers."""
    landmarks, observations, living = landmarks_of(map), observations_of(map), living_keyframes(map)
    for kind, table in landmarks.items():
        ids = np.flatnonzero(table.column("alive"))
        landmarks[kind] = table.keeping(np.stack([ids, ids + 1], axis=1))
        observations[kind] = observations[kind].keeping(map.keyframes.rows(kind.span_column, living))
    return with_tables(map, landmarks, observations)
