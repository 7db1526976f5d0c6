"""Which matches of a frame agree with its final pose, and which features are new to the map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, Bool, Camera, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.numerics.maps.map_terms import line_terms, plane_terms, point_terms
from trihedron.plugins.numerics.motion.pose_solver import classify_terms

NOTHING = np.empty((0, 2), np.int32)


@dataclass(frozen=True)
class Associated:
    """Pairs (row of the feature, id of the landmark) that agree with the pose, each landmark of points and lines once, and the rows that are new."""

    points: I32
    new_points: I32
    lines: I32
    new_lines: I32
    planes: I32
    new_planes: I32


def associate(
    map: Map,
    camera: Camera,
    T_world_camera: F64,
    keypoints: Keypoints,
    segments: Segments,
    planes: Planes,
    matches: Matches | None,
    line_sigma_px: float,
    judged: bool = True,
) -> Associated:
    """Judge the matches at the final pose, unless they are not to be `judged`. A plane that was matched but does not agree is neither measured again
    nor new: a second copy of a wall would do more harm than a lost measurement. New points and lines need a 3D position."""
    pairs = (matches.keypoints, matches.segments, matches.planes) if matches is not None else (NOTHING, NOTHING, NOTHING)
    points, lines, same = (kept[_alive(map, kind, kept[:, 1])] for kept, kind in zip(pairs, ("points", "lines", "planes")))
    agreeing = same
    if judged and matches is not None:
        flags = classify_terms(
            T_world_camera,
            camera,
            point_terms(map, keypoints, points),
            line_terms(map, segments, lines, T_world_camera, camera, line_sigma_px),
            plane_terms(map, planes, same, NOTHING, NOTHING, 1.0),
        )
        points, lines, agreeing = points[flags.points > 0], lines[flags.lines > 0], same[flags.planes > 0]
    return Associated(
        points,
        _others(_known(keypoints.points_m), points[:, 0]),
        lines,
        _others(_known(segments.endpoints_m), lines[:, 0]),
        agreeing,
        _others(np.ones(len(planes.coefficients), np.bool_), same[:, 0]),
    )


def existing(matches: Matches, map: Map) -> Matches:
    """The matches without ids that the map does not have: a replay of the map alone is given matches made against the recorded one."""
    sizes = len(map.points), len(map.lines), len(map.planes)
    pairs = (matches.keypoints, matches.segments, matches.planes)
    keypoints, segments, planes = (kept[kept[:, 1] < size] for kept, size in zip(pairs, sizes))
    points, lines = (ids[ids < size] for ids, size in zip((matches.visible_points, matches.visible_lines), sizes))
    return replace(matches, keypoints=keypoints, segments=segments, planes=planes, visible_points=points, visible_lines=lines)


def _alive(map: Map, kind: str, ids: I32) -> Bool:
    alive: Bool = getattr(map, kind).rows("alive", ids)
    return alive


def _known(positions: F32) -> Bool:
    """Rows without NaN."""
    return np.asarray(np.isfinite(positions).all(axis=tuple(range(1, positions.ndim))), np.bool_)


def _others(usable: Bool, taken: I32) -> I32:
    """Usable rows that are not taken."""
    usable = usable.copy()
    usable[taken] = False
    return np.flatnonzero(usable).astype(np.int32)
