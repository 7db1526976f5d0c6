"""The part of the map near the camera: a bounded number of keyframes, whatever the size of the map, and the landmarks they see."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import F64, I32, Bool, Map, Table
from trihedron.plugins.mapping.landmarks import among, distinct, places

T = TypeVar("T")
WEIGHTS = {"point": 1, "line": 5, "plane": 20}  # how strongly a shared one ties keyframes: a bare room has few landmarks, all of them large


@dataclass(frozen=True)
class LocalWindow:
    """Rows of keyframes and ids of the living landmarks they see, each sorted."""

    keyframes: I32
    points: I32
    lines: I32
    planes: I32

    def columns(self, map: Map, kind: str, *names: str) -> list[NDArray[Any]]:
        """What the map holds of all landmarks of a kind ('points', 'lines', 'planes'), in columns: a window stays the same from frame to frame until
        a keyframe comes."""
        ids: I32 = getattr(self, kind)
        return _once(map, (kind, names, ids.tobytes()), lambda: getattr(map, kind).gathered(ids, *names))


def _once(map: Map, key: Hashable, find: Callable[[], T]) -> T:
    """What is asked of one version of the map, frame after frame, is found once."""
    if key not in map.memo:
        map.memo[key] = find()
    found: T = map.memo[key]
    return found


def newest_keyframes(map: Map, count: int) -> I32:
    """The last `count` living keyframes of the sub-map of the newest, oldest first."""
    return _once(map, ("newest", count), lambda: _newest(map, count))


def _newest(map: Map, count: int) -> I32:
    start = max(len(map.keyframes) - 4 * count, 0)
    rows = np.arange(start, len(map.keyframes), dtype=np.int32)
    rows = rows[map.keyframes.rows("alive", rows)]
    submaps = map.keyframes.rows("submap", rows)
    return rows[submaps == submaps[-1]][-count:] if len(rows) else rows


def living_keyframes(map: Map) -> I32:
    """All living keyframes, oldest first; on a long run most are retired, so that what is asked of these alone costs little."""
    return _once(map, "living", lambda: np.flatnonzero(map.keyframes.column("alive")).astype(np.int32))


def keyframes_of(map: Map, submap: int) -> I32:
    """The living keyframes of a sub-map."""
    living = living_keyframes(map)
    return _once(map, ("living", submap), lambda: living[map.keyframes.rows("submap", living) == submap])


def current_submap(map: Map) -> int:
    """The sub-map of the newest keyframe: what is tracked now."""
    newest = newest_keyframes(map, 1)
    return int(map.keyframes.rows("submap", newest)[0]) if len(newest) else 0


def observed_by(map: Map, keyframes: I32, kind: str) -> I32:
    """Ids of the living `kind` landmarks ('point', 'line', 'plane') that the keyframes saw, sorted."""
    return _living(map, _observed(map, keyframes, kind)[0], kind)


def observed_by_each(map: Map, keyframes: I32, kind: str) -> tuple[I32, I32, NDArray[np.int64]]:
    """`observed_by` all the keyframes, the rows among those of what each of them in turn saw (-1: dead by now), and where what it saw ends, (n,)."""
    observed, ends = _observed(map, keyframes, kind)
    ids = _living(map, observed, kind)
    return ids, places(observed, ids), ends


def _observed(map: Map, keyframes: I32, kind: str) -> tuple[I32, NDArray[np.int64]]:
    """Ids of what each keyframe in turn saw, dead or alive, and where what it saw ends, (n,)."""
    ranges = map.keyframes.rows(f"{kind}s", keyframes)
    rows = np.concatenate([np.arange(a, b, dtype=np.int32) for a, b in ranges]) if len(ranges) else np.empty(0, np.int32)
    table: Table = getattr(map, f"{kind}_observations")
    return table.rows(kind, rows), np.cumsum(ranges[:, 1] - ranges[:, 0])


def _living(map: Map, ids: I32, kind: str) -> I32:
    """Those of the ids that live, once each and sorted."""
    ids = distinct(ids)
    alive: Bool = getattr(map, f"{kind}s").rows("alive", ids)
    return ids[alive]


def _votes(map: Map, keyframes: I32) -> I32:
    """How strongly each keyframe of the map shares landmarks of any kind with the given ones, (keyframes of the map,)."""
    votes = np.zeros(len(map.keyframes), np.int64)
    for kind, weight in WEIGHTS.items():
        observers = getattr(map, f"{kind}s").rows("observers", observed_by(map, keyframes, kind))
        votes += weight * np.bincount(observers[observers >= 0], minlength=len(votes))
    return votes.astype(np.int32)


def covisible_keyframes(map: Map, keyframes: I32, count: int) -> I32:
    """At most `count` further living keyframes that share most landmarks with the given ones, most first and of equals the newest."""
    return _once(map, ("covisible", keyframes.tobytes(), count), lambda: _covisible(map, keyframes, count))


def _covisible(map: Map, keyframes: I32, count: int) -> I32:
    living = living_keyframes(map)
    votes = np.where(among(living, keyframes), 0, _votes(map, keyframes)[living])
    order = len(votes) - 1 - np.argsort(-votes[::-1], kind="stable")[:count]
    return living[order[votes[order] > 0]]


def _near(map: Map, T_world_camera: F64, near_m: float, near_deg: float, submap: int) -> I32:
    """Living keyframes of the sub-map taken from about here in about this direction, nearest first."""
    living = keyframes_of(map, submap)
    poses = _once(map, ("poses", submap), lambda: map.keyframes.rows("T_world_camera", living))
    distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
    cosine = poses[:, :3, 2] @ T_world_camera[:3, 2]
    near = np.flatnonzero((distance < near_m) & (cosine > np.cos(np.radians(near_deg))))
    return living[near[np.argsort(distance[near] / near_m + (1.0 - cosine[near]), kind="stable")]]


def local_window(
    map: Map,
    T_world_camera: F64,
    newest: int,
    covisible: int,
    near: int,
    near_m: float = 1.0,
    near_deg: float = 30.0,
    submap: int | None = None,
) -> LocalWindow:
    """The `newest` keyframes, the `covisible` ones that share most landmarks with them, and up to `near` further ones taken from about
    `T_world_camera` (within `near_m` and `near_deg`): a place seen again after its landmarks' last observers were forgotten.
    All are of one sub-map: that of the newest keyframe, or the one given."""
    submap = current_submap(map) if submap is None else submap
    chosen = newest_keyframes(map, max(newest, 1))[:newest] if submap == current_submap(map) else np.empty(0, np.int32)
    chosen = np.concatenate([chosen, covisible_keyframes(map, chosen, covisible)])
    beside = _near(map, T_world_camera, near_m, near_deg, submap)
    beside = beside[~among(beside, chosen)][:near]
    return window_of(map, np.sort(np.concatenate([chosen, beside])).astype(np.int32))


def window_of(map: Map, keyframes: I32) -> LocalWindow:
    """The keyframes (sorted rows) and what they see."""

    def seen() -> LocalWindow:
        return LocalWindow(keyframes, *(observed_by(map, keyframes, kind) for kind in ("point", "line", "plane")))

    return _once(map, ("window", keyframes.tobytes()), seen)
