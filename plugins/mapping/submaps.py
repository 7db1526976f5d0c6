"""Parts of the map that were made while the camera did not know where it was, and how they are tied to the rest."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.types import F64, I32, Map, Pose, Table
from trihedron.plugins.mapping.correction import carried
from trihedron.plugins.mapping.covisibility_graph import keyframes_of
from trihedron.plugins.mapping.merging import fuse_planes
from trihedron.plugins.mapping.reference_keyframe import submap_of


def tied(map: Map, pose: Pose, recognised: Pose, max_deg: float, max_m: float) -> Map:
    """The map with the sub-map of `pose` moved rigidly to where the same frame was `recognised` in another one, which takes it over. Planes of the
    two that are one (see `merging.fuse_planes`) are fused now, points and lines when they are next seen."""
    submap = submap_of(pose, map)
    if submap == recognised.submap:
        return map
    rows = np.flatnonzero(map.keyframes.column("submap") == submap).astype(np.int32)
    T: F64 = recognised.T_world_camera @ invert(pose.T_world_camera)
    map = carried(map, T, rows, *(_first_seen_by(getattr(map, kind), rows) for kind in ("points", "lines", "planes")))
    mine = _first_seen_by(map.planes, keyframes_of(map, submap))
    theirs = _first_seen_by(map.planes, keyframes_of(map, recognised.submap))
    changes: dict[str, Any] = {"keyframes": map.keyframes.updated(rows, submap=np.full(len(rows), recognised.submap, np.int32))}
    return fuse_planes(replace(map, **changes), theirs, mine, max_deg, max_m)


def _first_seen_by(table: Table, keyframes: I32) -> I32:
    """Living landmarks that these keyframes created."""
    return np.flatnonzero(table.column("alive") & np.isin(table.column("first"), keyframes)).astype(np.int32)
