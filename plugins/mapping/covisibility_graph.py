"""The covisibility graph: keyframes connected by the landmarks they share, its sub-maps, and local windows of it, bounded whatever the map's size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.linalg import inv, matmul, norm
from trihedron.pipeline.core.types import F64, I32, Bool, Map
from trihedron.plugins.mapping.landmark_kinds import KINDS, LINE, PLANE, POINT, LandmarkKind, landmarks_of, observed_rows
from trihedron.plugins.mapping.landmarks import distinct, index_of, isin

P = ParamSpec("P")
T = TypeVar("T")
WEIGHTS = {POINT: 1, LINE: 5, PLANE: 20}  # of a shared landmark, by kind: a bare room has few landmarks, all of them large
VICINITY_M, VICINITY_DEG = 2.0, 60.0  # of a place, within which keyframes observed it


def once_per_version(function: Callable[Concatenate[Map, P], T]) -> Callable[Concatenate[Map, P], T]:
    """Cache the results of a function of a map and further positional arguments (values or arrays) with that version of the map."""

    @wraps(function)
    def cached(map: Map, /, *args: P.args, **kwargs: P.kwargs) -> T:
        key = (function.__name__, *(arg.tobytes() if isinstance(arg, np.ndarray) else arg for arg in args), *kwargs.items())
        if key not in map.memo:
            map.memo[key] = function(map, *args, **kwargs)
        found: T = map.memo[key]
        return found

    return cached


@dataclass(frozen=True)
class LocalWindow:
    """Rows of keyframes and ids of the living landmarks they observed, each sorted."""

    keyframes: I32
    points: I32
    lines: I32
    planes: I32

    def columns(self, map: Map, kind: LandmarkKind, *names: str) -> list[NDArray[Any]]:
        """Gather columns of the landmarks of a kind; a window stays the same from frame to frame until a keyframe comes."""
        return _columns(map, {POINT: self.points, LINE: self.lines, PLANE: self.planes}[kind], kind, names)


@once_per_version
def _columns(map: Map, ids: I32, kind: LandmarkKind, names: tuple[str, ...]) -> list[NDArray[Any]]:
    return landmarks_of(map)[kind].columns_at(ids, *names)


# Keyframes and sub-maps.


@once_per_version
def newest_keyframes(map: Map, count: int) -> I32:
    """Return the last `count` living keyframes of the newest one's sub-map, oldest first."""
    start = max(len(map.keyframes) - 4 * count, 0)
    rows = np.arange(start, len(map.keyframes), dtype=np.int32)
    rows = rows[map.keyframes.rows("alive", rows)]
    submaps = map.keyframes.rows("submap", rows)
    return rows[submaps == submaps[-1]][-count:] if len(rows) else rows


@once_per_version
def living_keyframes(map: Map) -> I32:
    """Return all living keyframes, oldest first; on a long run most are culled."""
    return np.flatnonzero(map.keyframes.column("alive")).astype(np.int32)


@once_per_version
def keyframes_of(map: Map, submap: int) -> I32:
    """Return the living keyframes of a sub-map."""
    living = living_keyframes(map)
    return np.asarray(living[map.keyframes.rows("submap", living) == submap])


def current_submap(map: Map) -> int:
    """Return the sub-map of the newest keyframe, which is the tracked one."""
    newest = newest_keyframes(map, 1)
    return int(map.keyframes.rows("submap", newest)[0]) if len(newest) else 0


# Edges: shared landmarks.


def observed_by(map: Map, keyframes: I32, kind: LandmarkKind) -> I32:
    """Return the ids of the living landmarks of a kind that the keyframes observed, sorted."""
    return _living(map, observed_rows(map, keyframes, kind)[1], kind)


def observed_by_each(map: Map, keyframes: I32, kind: LandmarkKind) -> tuple[I32, I32, NDArray[np.int64]]:
    """Return `observed_by` of all the keyframes, the index among those of every observation of each keyframe in turn (-1: dead by now), and where
    the observations of each keyframe end (n,)."""
    _, observed, counts = observed_rows(map, keyframes, kind)
    ids = _living(map, observed, kind)
    return ids, index_of(observed, ids), np.cumsum(counts)


def _living(map: Map, ids: I32, kind: LandmarkKind) -> I32:
    ids = distinct(ids)
    alive: Bool = landmarks_of(map)[kind].rows("alive", ids)
    return ids[alive]


@once_per_version
def covisible_keyframes(map: Map, keyframes: I32, count: int) -> I32:
    """Return at most `count` further living keyframes that share most landmarks with the given ones, most first and of equals the newest."""
    weights = np.zeros(len(map.keyframes), np.int64)
    for kind, table in landmarks_of(map).items():
        observers = table.rows("observers", observed_by(map, keyframes, kind))
        weights += WEIGHTS[kind] * np.bincount(observers[observers >= 0], minlength=len(weights))
    living = living_keyframes(map)
    weights = np.where(isin(living, keyframes), 0, weights[living])
    order = len(weights) - 1 - np.argsort(-weights[::-1], kind="stable")[:count]
    return living[order[weights[order] > 0]]


def revisits(map: Map, keyframes: I32, shared: int, links: int) -> I32:
    """Return pairs (e, 2) of indices among the keyframes (sorted), the earlier first, that share at least `shared` points and lines although at
    least `links` keyframes in a row between them share less with the later: the camera left and came back. Of each visit it is the one that shares
    most."""
    earlier, later, common = _sharing(map, keyframes)
    earlier, later, common = (values[common >= shared] for values in (earlier, later, common))
    begins = np.flatnonzero((np.diff(later, prepend=-1) > 0) | (np.diff(earlier, prepend=-1) > links))
    found = []
    for visit in np.split(np.arange(len(later)), begins[1:]):
        if len(visit) and later[visit[-1]] - earlier[visit[-1]] > links:
            best = visit[np.argmax(common[visit])]
            found.append((earlier[best], later[best]))
    return np.array(found, np.int32).reshape(-1, 2)


def _sharing(map: Map, keyframes: I32) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of indices (p,) among the keyframes, the earlier and the later, sorted by the later and then the earlier, that share points or lines, and
    how many (p,)."""
    pairs = [np.empty(0, np.int64)]
    for kind in (POINT, LINE):
        _, observed, ends = observed_by_each(map, keyframes, kind)
        by_landmark = np.argsort(observed, kind="stable")[np.count_nonzero(observed < 0) :]
        landmarks, observers, apart = observed[by_landmark], np.repeat(np.arange(len(keyframes)), np.diff(ends, prepend=0))[by_landmark], 1
        while (same := landmarks[apart:] == landmarks[:-apart]).any():  # a landmark with k observers gives pairs up to k - 1 apart
            pairs.append(observers[apart:][same] * len(keyframes) + observers[:-apart][same])
            apart += 1
    pair, common = np.unique(np.concatenate(pairs), return_counts=True)
    later, earlier = np.divmod(pair, max(len(keyframes), 1))
    return earlier, later, common


# Local windows.


@once_per_version
def _poses(map: Map, submap: int) -> F64:
    poses: F64 = map.keyframes.rows("T_world_camera", keyframes_of(map, submap))
    return poses


def _near(map: Map, T_world_camera: F64, near_m: float, near_deg: float, submap: int) -> I32:
    """Living keyframes of the sub-map with about this position and viewing direction, nearest first."""
    poses = _poses(map, submap)
    distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
    cosine = matmul(poses[:, :3, 2], T_world_camera[:3, 2])
    near = np.flatnonzero((distance < near_m) & (cosine > np.cos(np.radians(near_deg))))
    return keyframes_of(map, submap)[near[np.argsort(distance[near] / near_m + (1.0 - cosine[near]), kind="stable")]]


def local_window(
    map: Map, T_world_camera: F64, newest: int, covisible: int, near: int, near_m: float = 1.0, near_deg: float = 30.0, submap: int | None = None
) -> LocalWindow:
    """Return the window of the `newest` keyframes, the `covisible` ones that share most landmarks with them, and up to `near` further ones within
    `near_m` and `near_deg` of `T_world_camera`: these know a place that is revisited after its landmarks' last observers were forgotten.
    All are of one sub-map: that of the newest keyframe, or the one given."""
    submap = current_submap(map) if submap is None else submap
    chosen = newest_keyframes(map, max(newest, 1))[:newest] if submap == current_submap(map) else np.empty(0, np.int32)
    chosen = np.concatenate([chosen, covisible_keyframes(map, chosen, covisible)])
    beside = _near(map, T_world_camera, near_m, near_deg, submap)
    beside = beside[~isin(beside, chosen)][:near]
    return window_of(map, np.sort(np.concatenate([chosen, beside])).astype(np.int32))


@once_per_version
def window_of(map: Map, keyframes: I32) -> LocalWindow:
    """Return the window of the keyframes (sorted rows)."""
    return LocalWindow(keyframes, *(observed_by(map, keyframes, kind) for kind in KINDS))


def are_distinct(T: F64, other: F64) -> bool:
    """Return True if two poses differ by 10 cm or 5°."""
    cosine = 0.5 * (np.trace(matmul(T[:3, :3].T, other[:3, :3])) - 1.0)
    return bool(norm(T[:3, 3] - other[:3, 3]) > 0.1 or cosine < np.cos(np.radians(5.0)))


# Odometry: the edges between keyframes that follow each other.

LEAST_SIGMA_M, LEAST_SIGMA = 1e-3, 1e-4  # standard deviations between two keyframes at one place, m and rad


class DriftOptions(Protocol):
    """Options of every plugin that measures the motion between keyframes by odometry."""

    @property
    def drift_share(self) -> float:
        """Standard deviation of the position (m) per root metre."""

    @property
    def rotation_drift_deg(self) -> float:
        """Standard deviation of the rotation per root metre."""


def odometry(options: DriftOptions, map: Map, pairs: I32, times: float = 1.0) -> tuple[F64, F64]:
    """Return the motions `T_a_b` (e, 4, 4) between pairs (e, 2) of keyframes, the earlier first, and the information (e, 6, 6) of their xi.

    The covariance is `times` that of the later keyframe's pose plus the drift along the path."""
    poses = map.keyframes.rows("T_world_camera", pairs.ravel()).reshape(-1, 2, 4, 4)
    motions = matmul(invert(poses[:, 0]), poses[:, 1])
    length = np.linalg.norm(motions[:, :3, 3], axis=1)[:, None, None]
    covariance = times * map.keyframes.rows("covariance", pairs[:, 1])
    covariance[:, :3, :3] += times * (options.drift_share**2 * length + LEAST_SIGMA_M**2) * np.eye(3)
    covariance[:, 3:, 3:] += times * (np.radians(options.rotation_drift_deg) ** 2 * length + LEAST_SIGMA**2) * np.eye(3)
    return np.ascontiguousarray(motions), np.asarray(inv(covariance), np.float64)
