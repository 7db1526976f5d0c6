"""What a keyframe adds to the map: measurements of known points, lines and planes, new ones, and the rows that say who saw what.

Every function takes a map and returns a new version of it. `keyframe` is the row of the keyframe that is being inserted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis, transform, transform_planes
from trihedron.pipeline.core.types import F32, F64, I32, Bool, Camera, Keypoints, Map, Matches, Planes, Pose, Segments, Table
from trihedron.plugins.mapping import plane_fusion
from trihedron.plugins.mapping.insertion_kernels import fuse_lines, fuse_points
from trihedron.plugins.mapping.landmarks import OBSERVERS
from trihedron.plugins.mapping.plane_fusion_kernels import spread as spread_samples
from trihedron.plugins.mapping.reprojection import line_terms, plane_terms, point_terms, points_along
from trihedron.plugins.shared.linalg import inverse, moved_covariance, point_covariance, rotate_covariance
from trihedron.plugins.shared.pose_optimizer import classify_terms


@dataclass(frozen=True)
class Observations:
    """The keyframe being inserted: its row, camera and pose."""

    keyframe: int
    camera: Camera
    T_world_camera: F64
    covariance: F64  # (6, 6)


def add_keyframe(map: Map, pose: Pose, camera: Camera) -> tuple[Map, int]:
    """A version with one more keyframe, whose observation rows are still to come, and its row."""
    empty = np.zeros((1, 2), np.int32)
    table, rows = map.keyframes.appended(
        index=np.array([pose.index]),
        stamp_ns=np.array([pose.stamp_ns]),
        T_world_camera=pose.T_world_camera[None],
        covariance=pose.covariance[None],
        intrinsics=camera.intrinsics[None],
        points=empty,
        lines=empty,
        planes=empty,
        submap=np.array([pose.submap]),
        alive=np.ones(1, np.bool_),
    )
    return replace(map, keyframes=table), int(rows[0])


def count_visible(table: Table, ids: I32) -> Table:
    """One more keyframe in which these landmarks should have been seen."""
    return table.updated(ids, visible=table.rows("visible", ids) + 1)


def _found(table: Table, ids: I32, keyframe: int) -> dict[str, Any]:
    """Life columns of landmarks seen by one more keyframe."""
    observers = np.concatenate([np.full((len(ids), 1), keyframe, np.int32), table.rows("observers", ids)[:, :-1]], axis=1)
    return {"observers": observers, "found": table.rows("found", ids) + 1}


def _born(count: int, keyframe: int) -> dict[str, Any]:
    """Life columns of new landmarks."""
    observers = np.full((count, OBSERVERS), -1, np.int32)
    observers[:, 0] = keyframe
    one = np.ones(count, np.int32)
    return {"first": one * keyframe, "observers": observers, "found": one, "visible": one, "alive": np.ones(count, np.bool_)}


def _tied(map: Map, kind: str, keyframe: int, **columns: Any) -> Map:
    """Append rows to the observation table of `kind` and note their range with the keyframe."""
    table, rows = getattr(map, f"{kind}_observations").appended(keyframe=np.full(len(columns[kind]), keyframe, np.int32), **columns)
    span = np.array([[table.size - len(rows), table.size]], np.int32)
    keyframes = map.keyframes.updated(np.array([keyframe]), **{f"{kind}s": span})
    changes: dict[str, Any] = {f"{kind}_observations": table, "keyframes": keyframes}
    return replace(map, **changes)


def insert_points(map: Map, view: Observations, keypoints: Keypoints, pairs: I32, new: I32, memory: float) -> Map:
    """Measure the points `pairs` (row, id) again and make landmarks of the rows `new`, which have depth."""
    rows, ids = pairs[:, 0], pairs[:, 1]
    table = map.points
    position, information = table.rows("position_m", ids), table.rows("information", ids).astype(np.float64)
    sigma_px, sigma_m = keypoints.sigma_px.astype(np.float64), keypoints.sigma_m.astype(np.float64)
    pixels, depth = keypoints.pixels.astype(np.float64), keypoints.points_m[:, 2].astype(np.float64)
    fuse_points(
        view.T_world_camera, view.covariance, view.camera.intrinsics, position, information,
        pixels[rows], depth[rows], sigma_px[rows], sigma_m[rows], memory,
    )  # fmt: skip
    looks = _look(view, keypoints, rows, position)
    table = table.updated(ids, position_m=position, information=information, **looks, **_found(table, ids, view.keyframe))
    local = keypoints.points_m[new].astype(np.float64)
    covariance = point_covariance(local, sigma_px[new], sigma_m[new], view.camera) + moved_covariance(local, view.covariance)
    position = transform(view.T_world_camera, local)
    table, born = table.appended(
        position_m=position,
        information=inverse(rotate_covariance(view.T_world_camera[:3, :3], covariance)),
        **_look(view, keypoints, new, position),
        **_born(len(new), view.keyframe),
    )
    seen = np.concatenate([rows, new])
    return _tied(
        replace(map, points=table),
        "point",
        view.keyframe,
        point=np.concatenate([ids, born]),
        pixel=keypoints.pixels[seen],
        depth_m=keypoints.points_m[seen, 2],
        sigma_px=keypoints.sigma_px[seen],
        sigma_m=keypoints.sigma_m[seen],
    )


def _look(view: Observations, keypoints: Keypoints, rows: I32, position: F64) -> dict[str, Any]:
    """How points look from here: descriptor, direction, distance and octave."""
    away = view.T_world_camera[:3, 3] - position
    distance = np.linalg.norm(away, axis=1)
    return {
        "descriptor": keypoints.descriptors[rows],
        "direction": (away / distance[:, None]).astype(np.float32),
        "distance_m": distance.astype(np.float32),
        "octave": keypoints.octaves[rows],
    }


def insert_lines(map: Map, view: Observations, segments: Segments, pairs: I32, new: I32, sigma_px: float, memory: float) -> Map:
    """Measure the lines `pairs` (row, id) again, lengthen them to what is seen, and make landmarks of the rows `new`, which have a 3D line."""
    rows, ids = pairs[:, 0], pairs[:, 1]
    table = map.lines
    endpoints, information = table.rows("endpoints_m", ids), table.rows("information", ids).astype(np.float64)
    observed, covariance = segments.endpoints_m.astype(np.float64), segments.covariance_m2.astype(np.float64)
    fuse_lines(
        view.T_world_camera, view.covariance, view.camera.intrinsics, endpoints, information,
        segments.endpoints_px[rows].astype(np.float64), observed[rows], covariance[rows], sigma_px, memory,
    )  # fmt: skip
    endpoints, information = lengthened(endpoints, information, transform(view.T_world_camera, observed[rows]))
    table = table.updated(
        ids, endpoints_m=endpoints, information=information, descriptor=segments.descriptors[rows], **_found(table, ids, view.keyframe)
    )
    local = observed[new]
    total = rotate_covariance(view.T_world_camera[:3, :3], covariance[new] + moved_covariance(local, view.covariance))
    table, born = table.appended(
        endpoints_m=transform(view.T_world_camera, local),
        information=inverse(total),
        descriptor=segments.descriptors[new],
        **_born(len(new), view.keyframe),
    )
    seen = np.concatenate([rows, new])
    ids = np.concatenate([ids, born])
    return _tied(
        replace(map, lines=table),
        "line",
        view.keyframe,
        line=ids,
        endpoints_px=segments.endpoints_px[seen],
        endpoints_m=segments.endpoints_m[seen],
        covariance_m2=segments.covariance_m2[seen],
    )


def lengthened(endpoints: F64, information: F32 | F64, observed: F64) -> tuple[F64, F64]:
    """Lines (n, 2, 3) made to reach as far as the observed ends (n, 2, 3; NaN = unknown), along their own direction."""
    direction = endpoints[:, 1] - endpoints[:, 0]
    share = np.einsum("nkj,nj->nk", observed - endpoints[:, :1], direction) / np.maximum((direction**2).sum(-1), 1e-12)[:, None]
    reach = np.stack([np.fmin(share.min(axis=1), 0.0), np.fmax(share.max(axis=1), 1.0)], axis=1)
    points, covariance = points_along(endpoints, inverse(information), reach)
    return points, inverse(covariance)


def insert_planes(map: Map, view: Observations, planes: Planes, pairs: I32, new: I32, memory: float) -> Map:
    """Re-estimate the planes `pairs` (row, id) from their summed moments and make landmarks of the rows `new`."""
    T = view.T_world_camera
    moments = plane_fusion.move_moments(T, plane_fusion.equivalent_moments(planes.coefficients, _uncertain(planes, view)))
    samples = transform(T, planes.samples_m.astype(np.float64)).astype(np.float32)
    table = map.planes
    ids, where = np.unique(pairs[:, 1], return_inverse=True)
    total = table.rows("moments", ids) * (1.0 - 1.0 / memory)
    np.add.at(total, where, moments[pairs[:, 0]])
    fitted, covariance = plane_fusion.fit_planes(total, table.rows("coefficients", ids))
    spread = [spread_samples(np.concatenate([old, *samples[pairs[where == k, 0]]]), len(old)) for k, old in enumerate(table.rows("samples_m", ids))]
    table = table.updated(
        ids,
        coefficients=fitted,
        covariance=covariance,
        moments=total,
        samples_m=plane_fusion.onto(np.array(spread, np.float32).reshape(-1, *table.schema["samples_m"].shape), fitted),
        **_found(table, ids, view.keyframe),
    )
    fitted, covariance = plane_fusion.fit_planes(moments[new], transform_planes(T, planes.coefficients[new]))
    table, born = table.appended(
        coefficients=fitted,
        covariance=covariance,
        moments=moments[new],
        samples_m=plane_fusion.onto(samples[new], fitted),
        **_born(len(new), view.keyframe),
    )
    seen = np.concatenate([pairs[:, 0], new])
    return _tied(
        replace(map, planes=table),
        "plane",
        view.keyframe,
        plane=np.concatenate([pairs[:, 1], born]),
        coefficients=planes.coefficients[seen],
        covariance=planes.covariance[seen],
        moments=planes.moments[seen],
    )


def _uncertain(planes: Planes, view: Observations) -> F64:
    """Covariance (n, 3, 3) of observed planes with that of the pose they were seen from."""
    B = tangent_basis(planes.coefficients[:, :3])
    J = np.zeros((len(B), 3, 6))
    n = planes.coefficients[:, :3]
    J[:, :2, 3:] = np.stack([np.cross(n, B[..., 0]), np.cross(n, B[..., 1])], axis=1)
    J[:, 2, :3] = n
    return planes.covariance + J @ view.covariance @ np.swapaxes(J, -1, -2)


# Which matches of a frame agree with its final pose, and which features are new to the map.

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
