"""Removing landmarks that are not found again, and keyframes that others make redundant or that show a place once more."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.types import F64, I32, Bool, Map, Matches, Table
from trihedron.plugins.numerics.maps.id_sets import among, union
from trihedron.plugins.numerics.maps.local_window import WEIGHTS, covisible_keyframes, keyframes_of, newest_keyframes, observed_by, observed_by_each
from trihedron.plugins.numerics.maps.retiring import retired

FARTHER = 1.2  # a landmark seen from at most this many times as far is seen as well: a level of the key points' pyramid
KEPT = 4  # newest keyframes that are never redundant yet: the newest one's landmarks are still on trial


def cull(map: Map, keyframe: int, matches: Matches | None, planes: I32, trial: int, min_found: float) -> Map:
    """Kill points and lines that were expected by this keyframe, or born `trial` keyframes ago, and `planes`, expected by it, that are found too
    seldom. Costs what is in view, not what is in the map."""
    young = np.array([keyframe - trial], np.int32) if keyframe >= trial else np.empty(0, np.int32)
    changes: dict[str, Any] = {}
    for kind, visible in (("point", "visible_points"), ("line", "visible_lines")):
        table: Table = getattr(map, f"{kind}s")
        ids = union(observed_by(map, young, kind), getattr(matches, visible) if matches is not None else young[:0])
        found, seen, first = table.gathered(ids, "found", "visible", "first")
        seldom = (found < min_found * seen) | ((first == keyframe - trial) & (found < trial) & (seen >= trial))
        ids = ids[seldom]
        changes[f"{kind}s"] = table.updated(ids, alive=np.zeros(len(ids), np.bool_))
    found, seen = map.planes.gathered(planes, "found", "visible")
    ids = planes[found < min_found * seen]
    changes["planes"] = map.planes.updated(ids, alive=np.zeros(len(ids), np.bool_))
    return replace(map, **changes)


def cull_keyframe(map: Map, others: int, share: float) -> Map:
    """Retire the one keyframe about the newest whose landmarks most are seen as well by at least `others` further ones, if these are more than
    `share` of them (ORB-SLAM: 90 % by three), all kinds weighed as in co-visibility. The first keyframe, which is the world, and the newest few are
    spared."""
    newest = newest_keyframes(map, KEPT)
    around = covisible_keyframes(map, newest, 2 * others) if len(newest) else newest
    around = np.sort(around[around > 0])
    shares = _redundancies(map, around, others) if len(around) else np.zeros(1)
    if shares.max() <= share:
        return map
    return retired(map, int(around[np.argmax(shares)]))


def cull_repeated(map: Map, shift_m: float, turn_deg: float, share: float) -> Map:
    """Retire the keyframe that has just left the newest few if beside an older one it would not have been made: within `shift_m` and `turn_deg` of
    it, no plane its own, and at least `share` of its landmarks, weighed as in co-visibility, known from there. It is the younger one that goes: a
    room that is seen again and again has as many keyframes as after the first time, and is held in its place by those."""
    newest = newest_keyframes(map, KEPT + 1)
    if len(newest) <= KEPT or newest[0] == 0:
        return map
    keyframe = newest[:1]
    older = keyframes_of(map, int(map.keyframes.rows("submap", keyframe)[0]))
    older = older[older < keyframe[0]]
    T = invert(map.keyframes.rows("T_world_camera", keyframe)) @ map.keyframes.rows("T_world_camera", older)
    cosine = 0.5 * (np.trace(T[:, :3, :3], axis1=1, axis2=2) - 1.0)
    near = older[(np.linalg.norm(T[:, :3, 3], axis=1) <= shift_m) & (cosine >= np.cos(np.radians(turn_deg)))]
    seen, known = 0, 0
    for kind, weight in WEIGHTS.items():
        own = observed_by(map, keyframe, kind)
        seen += weight * len(own)
        known += weight * np.count_nonzero(among(own, observed_by(map, near, kind)))
    planes = observed_by(map, keyframe, "plane")
    if not len(near) or known < share * seen or not among(planes, observed_by(map, older, "plane")).all():
        return map
    return retired(map, int(keyframe[0]))


def _redundancies(map: Map, keyframes: I32, others: int) -> F64:
    """(n,) weighed share of each keyframe's living landmarks that at least so many other living keyframes saw from as near."""
    seen, redundant = np.zeros(len(keyframes)), np.zeros(len(keyframes))
    for kind, weight in WEIGHTS.items():
        table: Table = getattr(map, f"{kind}s")
        ids, observed, ends = observed_by_each(map, keyframes, kind)
        observers, centres = table.rows("observers", ids), _centres(table, kind, ids)
        rows = union(observers[observers >= 0], keyframes)
        known, alive = map.keyframes.gathered(rows, "T_world_camera", "alive")
        counts = _seen_as_near(observed, ends, keyframes, observers, centres, rows, known, alive, others)
        seen += weight * counts[0]
        redundant += weight * counts[1]
    return redundant / np.maximum(seen, 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _seen_as_near(
    observed: I32, ends: NDArray[np.int64], keyframes: I32, observers: I32, centres: F64, rows: I32, poses: F64, alive: Bool, others: int
) -> NDArray[np.int64]:
    """(2, n) how many landmarks each keyframe saw, and how many of them at least so many others that live saw from as near: `observed` those of each
    keyframe in turn up to its end, -1 what does not count, `observers` (m, OBSERVERS) and `centres` (m, 3) of the landmarks, `poses` (k, 4, 4) and
    `alive` (k,) of the keyframes `rows`, sorted, among which all observers are."""
    place, counts = np.empty(rows[-1] + 1, np.int32), np.zeros((2, len(keyframes)), np.int64)
    for k in range(len(rows)):
        place[rows[k]] = k
    counted, begin = np.full(len(centres), -1), 0  # the last keyframe that a landmark was counted for
    for k in range(len(keyframes)):
        for o in range(begin, ends[k]):
            i = observed[o]
            if i < 0 or counted[i] == k:
                continue
            counted[i] = k
            reach, count = FARTHER * _away(poses[place[keyframes[k]]], centres[i]), 0
            for row in observers[i]:
                if row >= 0 and row != keyframes[k] and alive[place[row]]:
                    count += _away(poses[place[row]], centres[i]) <= reach
            counts[0, k] += 1
            counts[1, k] += count >= others
        begin = ends[k]
    return counts


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _away(T: F64, p: F64) -> float:
    """How far a point is from a camera."""
    x, y, z = T[0, 3] - p[0], T[1, 3] - p[1], T[2, 3] - p[2]
    return np.sqrt(x * x + y * y + z * z)


def _centres(table: Table, kind: str, ids: I32) -> F64:
    """(n, 3) where landmarks are."""
    if kind == "point":
        return table.rows("position_m", ids)
    if kind == "line":
        return np.asarray(table.rows("endpoints_m", ids).mean(axis=1), np.float64)
    samples = table.rows("samples_m", ids).astype(np.float64)
    known = np.isfinite(samples).all(axis=2, keepdims=True)
    return np.asarray(np.where(known, samples, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1), np.float64)
