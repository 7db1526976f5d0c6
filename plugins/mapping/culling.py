"""Removing landmarks that are not found again, and keyframes that others make redundant or that show a place once more."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert
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
from trihedron.plugins.mapping.culling_kernels import seen_as_near
from trihedron.plugins.mapping.landmarks import among, union

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
        known += weight * int(np.count_nonzero(among(own, observed_by(map, near, kind))))
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
        counts = seen_as_near(observed, ends, keyframes, observers, centres, rows, known, alive, others)
        seen += weight * counts[0]
        redundant += weight * counts[1]
    return redundant / np.maximum(seen, 1.0)


def _centres(table: Table, kind: str, ids: I32) -> F64:
    """(n, 3) where landmarks are."""
    if kind == "point":
        return table.rows("position_m", ids)
    if kind == "line":
        return np.asarray(table.rows("endpoints_m", ids).mean(axis=1), np.float64)
    samples = table.rows("samples_m", ids).astype(np.float64)
    known = np.isfinite(samples).all(axis=2, keepdims=True)
    return np.asarray(np.where(known, samples, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1), np.float64)


# Keyframes that leave the map, with what only they held up, and the memory that is given back.

KINDS = ("point", "line", "plane")


def retired(map: Map, keyframe: int) -> Map:
    """The map without a keyframe in any window. Its row stays, for the poses that hang on it; its measurements are given up. Landmarks forget it,
    and points and lines that no other one remembers die: nothing would look for them any more. Planes stay, for the surface."""
    row = np.array([keyframe], np.int32)
    changes: dict[str, Any] = {}
    for kind in KINDS:
        ids, table = observed_by(map, row, kind), getattr(map, f"{kind}s")
        observers = table.rows("observers", ids)
        observers = -np.sort(-np.where(observers == keyframe, -1, observers), axis=1)  # newest first, as before
        table = table.updated(ids, observers=observers)
        alone = ids[observers[:, 0] < 0] if kind != "plane" else ids[:0]
        changes[f"{kind}s"] = table.updated(alone, alive=np.zeros(len(alone), np.bool_))
    nothing = {f"{kind}s": np.zeros((1, 2), np.int32) for kind in KINDS}
    return replace(map, keyframes=map.keyframes.updated(row, alive=np.zeros(1, np.bool_), **nothing), **changes)


def released(map: Map) -> Map:
    """The same map with the chunks given back in which no landmark lives, or no living keyframe has a measurement; rows keep their numbers."""
    changes: dict[str, Any] = {}
    held = living_keyframes(map)
    for kind in KINDS:
        landmarks, measured = getattr(map, f"{kind}s"), getattr(map, f"{kind}_observations")
        ids = np.flatnonzero(landmarks.column("alive"))
        changes[f"{kind}s"] = landmarks.keeping(np.stack([ids, ids + 1], axis=1))
        changes[f"{kind}_observations"] = measured.keeping(map.keyframes.rows(f"{kind}s", held))
    return replace(map, **changes)
