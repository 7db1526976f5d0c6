"""Places the camera may have come back to: keyframes of long ago within reach of what it may have drifted since."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Map
from trihedron.plugins.numerics.maps.local_window import LocalWindow, current_submap, keyframes_of, observed_by


@dataclass(frozen=True)
class Reach:
    """What counts as long ago and as near, and how fast the camera's place gets uncertain: `drift_share` of the way walked (standard deviation)."""

    away_m: float  # walked since, at least
    view_m: float  # between two keyframes that see the same, besides the drift
    view_deg: float  # between their viewing directions
    drift_share: float
    floor_m: float

    def sigma_m(self, walked_m: F64) -> F64:
        """(n,) standard deviation of the position after a way (n,)."""
        return self.floor_m + self.drift_share * walked_m


@dataclass(frozen=True)
class Place:
    """A keyframe of long ago, those that saw the same from about there, the landmarks only they know, the way walked since, and how many points
    and lines of the place the newest keyframe has found already."""

    keyframe: int
    seen: LocalWindow
    walked_m: float
    found: int


def walked(map: Map) -> tuple[I32, F64]:
    """Rows of the living keyframes of the tracked sub-map and the way walked from each to the newest, metres."""
    rows = keyframes_of(map, current_submap(map))
    positions = map.keyframes.rows("T_world_camera", rows)[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return rows, np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])


def within_reach(map: Map, reach: Reach) -> tuple[I32, F64]:
    """Keyframes that the newest one may have come back to, nearest first, and the way walked since."""
    rows, way = walked(map)
    poses = map.keyframes.rows("T_world_camera", rows)
    distance = np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1)
    cosine = poses[:, :3, 2] @ poses[-1, :3, 2]
    good = (way > reach.away_m) & (distance < reach.view_m + 3.0 * reach.sigma_m(way)) & (cosine > np.cos(np.radians(reach.view_deg)))
    chosen = np.flatnonzero(good)
    chosen = chosen[np.argsort(distance[chosen] / reach.view_m + 1.0 - cosine[chosen], kind="stable")]
    return rows[chosen], way[chosen]


def place_of(map: Map, keyframe: int, walked_m: float, reach: Reach) -> Place:
    """The place around a keyframe."""
    rows, way = walked(map)
    poses = map.keyframes.rows("T_world_camera", rows)
    own = poses[np.searchsorted(rows, keyframe)]
    near = np.linalg.norm(poses[:, :3, 3] - own[:3, 3], axis=1) < reach.view_m
    near &= (poses[:, :3, 2] @ own[:3, 2] > np.cos(np.radians(reach.view_deg))) & (way > 0.5 * reach.away_m)
    recent = rows[way <= 0.5 * reach.away_m]
    found, ids = 0, []
    for kind in ("point", "line", "plane"):
        there, here = observed_by(map, rows[near], kind), observed_by(map, recent, kind)
        if kind != "plane":
            found += int(np.isin(observed_by(map, rows[-1:], kind), there).sum())
        ids.append(np.setdiff1d(there, here).astype(np.int32))
    return Place(keyframe, LocalWindow(rows[near], *ids), walked_m, found)
