"""Storeys of keyframes: how far the floor under the camera climbed along the path, by the level planes of the map."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Bool, Map
from trihedron.plugins.loop.manhattan_prior import estimate_axes
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmark_kinds import PLANE, observed_rows

STOREY_M = 2.4  # least from floor to floor
EYE_M = (1.2, 2.4)  # of a camera in the hand above the floor; what is nearer is furniture or a step, what is farther another storey
LEVEL_COS = float(np.cos(np.radians(10.0)))  # of a floor's normal and the vertical


def on_storey_of_last(map: Map, keyframes: I32, drift_share: float) -> Bool:
    """Return a mask (k,) of the keyframes, in the order of time, whose floor may be that of the last one: less than half a storey of climbs between
    them. All where the map has no Manhattan frame or no floor."""
    climb = climbs_m(map, keyframes, drift_share)
    return np.ones(len(keyframes), np.bool_) if climb is None else np.abs(climb - climb[-1]) < STOREY_M / 2.0


def climbs_m(map: Map, keyframes: I32, drift_share: float) -> F64 | None:
    """Return the height (k,) that the floor has climbed from the first keyframe to each; None without a Manhattan frame or a floor.

    Floors are level. So a change of their height by less than three standard deviations of the drift on that step is drift, and any other is
    stairs."""
    up = _vertical(map, keyframes)
    eye = None if up is None else _eye_heights_m(map, keyframes, up)
    if up is None or eye is None:
        return None
    positions = map.keyframes.rows("T_world_camera", keyframes)[:, :3, 3]
    change, step = np.diff(matmul(positions, up) - eye), np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.where(np.abs(change) > 3.0 * drift_share * step, change, 0.0))])


def _vertical(map: Map, keyframes: I32) -> F64 | None:
    """Return the axis (3,) of the Manhattan frame that is nearest to the cameras' mean upward direction."""
    planes = observed_by(map, keyframes, PLANE)
    R = estimate_axes(*(map.planes.rows(name, planes) for name in ("coefficients", "covariance", "found")))
    if R is None:
        return None
    along = -matmul(map.keyframes.rows("T_world_camera", keyframes)[:, :3, 1].mean(axis=0), R)
    axis = int(np.argmax(np.abs(along)))
    return np.asarray(R[:, axis] * np.sign(along[axis]), np.float64)


def _eye_heights_m(map: Map, keyframes: I32, up: F64) -> F64 | None:
    """Return the height (k,) of each camera above the floor that it observed, the lowest of several; where none is in view, as high as the camera was
    carried before. None without a floor."""
    _, planes, counts = observed_rows(map, keyframes, PLANE)
    observer = np.repeat(np.arange(len(keyframes)), counts)
    coefficients, positions = map.planes.rows("coefficients", planes), map.keyframes.rows("T_world_camera", keyframes)[observer, :3, 3]
    cosine = matmul(coefficients[:, :3], up)
    above = ((coefficients[:, :3] * positions).sum(axis=1) + coefficients[:, 3]) / np.maximum(cosine, LEVEL_COS)
    floor = map.planes.rows("alive", planes) & (cosine > LEVEL_COS) & (above > EYE_M[0]) & (above < EYE_M[1])
    highest = np.zeros(len(keyframes))
    np.maximum.at(highest, observer[floor], above[floor])
    known = np.flatnonzero(highest)
    if not len(known):
        return None
    return np.asarray(highest[known[np.maximum(np.searchsorted(known, np.arange(len(keyframes)), side="right") - 1, 0)]])
