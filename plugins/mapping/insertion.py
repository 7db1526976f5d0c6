"""Landmark insertion: a keyframe updates the points, lines and planes it observed again, adds new ones, and appends the observations.

Every function takes a map and returns a new version of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis, transform, transform_planes
from trihedron.pipeline.core.linalg import inv_symmetric, matmul
from trihedron.pipeline.core.types import F32, F64, I32, Bool, Camera, Keypoints, Map, Matches, Planes, Pose, Segments, Table
from trihedron.plugins.mapping.landmark_kernels import farthest_samples, fuse_lines, fuse_points
from trihedron.plugins.mapping.landmark_kinds import LINE, PLANE, POINT, LandmarkKind, observations_of, with_tables
from trihedron.plugins.mapping.landmarks import OBSERVERS
from trihedron.plugins.mapping.plane_fusion import equivalent_moments, fit_planes, move_moments, project_to_planes
from trihedron.plugins.mapping.projection import line_terms, parameters_on, plane_terms, point_terms, points_along
from trihedron.plugins.mapping.reference_keyframe import alignment_of_reference
from trihedron.plugins.shared.calibration_error import calibration_covariance
from trihedron.plugins.shared.covariances import point_covariance, propagate_pose_covariance
from trihedron.plugins.shared.pose_optimizer import classify_terms

NO_PAIRS = np.empty((0, 2), np.int32)


# Data association at the final pose.


@dataclass(frozen=True)
class Associated:
    """Inlier pairs (row of the feature, id of the landmark), each point and line once, and the rows of features that become new landmarks."""

    points: I32
    new_points: I32
    lines: I32
    new_lines: I32
    planes: I32
    new_planes: I32


def associate(
    map: Map, camera: Camera, T_world_camera: F64, keypoints: Keypoints, segments: Segments, planes: Planes, matches: Matches | None,
    line_sigma_px: float, judge: bool = True,
) -> Associated:  # fmt: skip
    """Classify the matches at the final pose; with `judge` False all are inliers. A plane that is an outlier is neither updated nor new: a duplicate
    of a wall would do more harm than a lost measurement. New points and lines need a 3D position."""
    pairs = (matches.keypoints, matches.segments, matches.planes) if matches is not None else (NO_PAIRS, NO_PAIRS, NO_PAIRS)
    points, lines, same = (matched[_alive(table, matched[:, 1])] for matched, table in zip(pairs, (map.points, map.lines, map.planes)))
    inliers = same
    if judge and matches is not None:
        on_lines = line_terms(map, segments, lines, T_world_camera, camera, math.hypot(line_sigma_px, keypoints.blur_px))
        on_planes = plane_terms(map, planes, same, NO_PAIRS, NO_PAIRS, 1.0)
        flags = classify_terms(T_world_camera, camera, point_terms(map, keypoints, points), on_lines, on_planes)
        points, lines, inliers = points[flags.points > 0], lines[flags.lines > 0], same[flags.planes > 0]
    new_points, new_lines = _others(_finite(keypoints.points_m), points), _others(_finite(segments.endpoints_m), lines)
    return Associated(points, new_points, lines, new_lines, inliers, _others(np.ones(len(planes.coefficients), np.bool_), same))


def existing(matches: Matches, map: Map) -> Matches:
    """Drop the matches with ids beyond the map's: a replay of the map alone is given matches made against the recorded map."""
    sizes = len(map.points), len(map.lines), len(map.planes)
    matched = (matches.keypoints, matches.segments, matches.planes)
    keypoints, segments, planes = (pairs[pairs[:, 1] < size] for pairs, size in zip(matched, sizes))
    points, lines = (ids[ids < size] for ids, size in zip((matches.visible_points, matches.visible_lines), sizes))
    return replace(matches, keypoints=keypoints, segments=segments, planes=planes, visible_points=points, visible_lines=lines)


def _alive(table: Table, ids: I32) -> Bool:
    alive: Bool = table.rows("alive", ids)
    return alive


def _finite(positions: F32) -> Bool:
    return np.asarray(np.isfinite(positions).all(axis=tuple(range(1, positions.ndim))), np.bool_)


def _others(usable: Bool, pairs: I32) -> I32:
    """Usable rows (True) that are in no pair (row, id)."""
    usable = usable.copy()
    usable[pairs[:, 0]] = False
    return np.flatnonzero(usable).astype(np.int32)


# Insertion.


@dataclass(frozen=True)
class Observations:
    """The keyframe being inserted: its row, camera, pose and the covariance of that."""

    keyframe: int
    camera: Camera
    T_world_camera: F64
    covariance: F64  # (6, 6)


def add_keyframe(map: Map, pose: Pose, camera: Camera) -> tuple[Map, int]:
    """Append a keyframe without observations; also returns its row. The velocity of the one before is known better by now."""
    empty, table = np.zeros((1, 2), np.int32), map.keyframes
    if 0 <= pose.reference < len(table):
        table = table.updated(np.array([pose.reference]), twist=pose.reference_twist[None])
    table, rows = table.appended(
        index=np.array([pose.index]),
        stamp_ns=np.array([pose.stamp_ns]),
        T_world_camera=pose.T_world_camera[None],
        covariance=pose.local_covariance[None],
        world_covariance=(pose.covariance - calibration_covariance(pose))[None],
        sensitivity=pose.sensitivity[None],
        **{name: value[None] for name, value in alignment_of_reference(pose, map).items()},
        twist=pose.twist[None],
        intrinsics=camera.intrinsics[None],
        points=empty,
        lines=empty,
        planes=empty,
        submap=np.array([pose.submap]),
        alive=np.ones(1, np.bool_),
    )
    evidence = {name: getattr(pose, name) for name in ("calibration_information", "calibration_score")}
    return replace(map, keyframes=table, **evidence), int(rows[0])


def count_visible(map: Map, points: I32, lines: I32, planes: I32) -> Map:
    """Count one more keyframe in which these landmarks are expected to be visible."""
    visible = ((map.points, points), (map.lines, lines), (map.planes, planes))
    tables = [table.updated(ids, visible=table.rows("visible", ids) + 1) for table, ids in visible]
    return replace(map, points=tables[0], lines=tables[1], planes=tables[2])


def _update_observation(table: Table, ids: I32, keyframe: int) -> dict[str, Any]:
    """Columns of landmarks observed by one more keyframe."""
    observers = np.concatenate([np.full((len(ids), 1), keyframe, np.int32), table.rows("observers", ids)[:, :-1]], axis=1)
    return {"observers": observers, "found": table.rows("found", ids) + 1}


def _new_landmark(count: int, keyframe: int) -> dict[str, Any]:
    """Columns of new landmarks."""
    observers = np.full((count, OBSERVERS), -1, np.int32)
    observers[:, 0] = keyframe
    one = np.ones(count, np.int32)
    return {"first": one * keyframe, "observers": observers, "found": one, "visible": one, "alive": np.ones(count, np.bool_)}


def _append_observations(map: Map, kind: LandmarkKind, keyframe: int, ids: I32, columns: dict[str, Any]) -> Map:
    """Append the observations of the landmarks `ids` by a keyframe, with these further columns, and their range to the keyframe."""
    columns = {"keyframe": np.full(len(ids), keyframe, np.int32), kind.id_column: ids, **columns}
    table, rows = observations_of(map)[kind].appended(**columns)
    span = np.array([[table.size - len(rows), table.size]], np.int32)
    return replace(with_tables(map, {}, {kind: table}), keyframes=map.keyframes.updated(np.array([keyframe]), **{kind.span_column: span}))


def _rows(features: Keypoints | Segments | Planes, rows: I32, *names: str) -> dict[str, Any]:
    """These fields of some features."""
    return {name: getattr(features, name)[rows] for name in names}


def insert_points(map: Map, view: Observations, keypoints: Keypoints, pairs: I32, new: I32, memory: float) -> Map:
    """Update the points `pairs` (row, id) and make landmarks of the rows `new`, which have depth."""
    rows, ids = pairs[:, 0], pairs[:, 1]
    table = map.points
    position, information = table.rows("position_m", ids), table.rows("information", ids).astype(np.float64)
    sigma_px, sigma_m = keypoints.sigma_px.astype(np.float64), keypoints.sigma_m.astype(np.float64)
    pixels, depth = keypoints.pixels.astype(np.float64), keypoints.points_m[:, 2].astype(np.float64)
    fuse_points(
        view.T_world_camera, view.covariance, view.camera.intrinsics, position, information,
        pixels[rows], depth[rows], sigma_px[rows], sigma_m[rows], memory,
    )  # fmt: skip
    appearance = _appearance(view, keypoints, rows, position)
    table = table.updated(ids, position_m=position, information=information, **appearance, **_update_observation(table, ids, view.keyframe))
    local = keypoints.points_m[new].astype(np.float64)
    covariance = point_covariance(local, sigma_px[new], sigma_m[new], view.camera) + propagate_pose_covariance(local, view.covariance)
    position, R = transform(view.T_world_camera, local), view.T_world_camera[:3, :3]
    table, created = table.appended(
        position_m=position,
        information=inv_symmetric(matmul(R, covariance, R.T)),
        **_appearance(view, keypoints, new, position),
        **_new_landmark(len(new), view.keyframe),
    )
    all_rows = np.concatenate([rows, new])
    measured = {"pixel": keypoints.pixels[all_rows], "depth_m": keypoints.points_m[all_rows, 2], **_rows(keypoints, all_rows, "sigma_px", "sigma_m")}
    return _append_observations(replace(map, points=table), POINT, view.keyframe, np.concatenate([ids, created]), measured)


def _appearance(view: Observations, keypoints: Keypoints, rows: I32, position: F64) -> dict[str, Any]:
    """Columns of points as this keyframe observed them: descriptor, viewing direction, distance and octave."""
    away = view.T_world_camera[:3, 3] - position
    distance = np.linalg.norm(away, axis=1)
    return {
        "descriptor": keypoints.descriptors[rows],
        "direction": (away / distance[:, None]).astype(np.float32),
        "distance_m": distance.astype(np.float32),
        "octave": keypoints.octaves[rows],
    }


def insert_lines(map: Map, view: Observations, segments: Segments, pairs: I32, new: I32, sigma_px: float, memory: float) -> Map:
    """Update the lines `pairs` (row, id), extend them to the observed ends, and make landmarks of the rows `new`, which have a 3D line."""
    rows, ids = pairs[:, 0], pairs[:, 1]
    table = map.lines
    endpoints, information = table.rows("endpoints_m", ids), table.rows("information", ids).astype(np.float64)
    observed, covariance = segments.endpoints_m.astype(np.float64), segments.covariance_m2.astype(np.float64)
    fuse_lines(
        view.T_world_camera, view.covariance, view.camera.intrinsics, endpoints, information,
        segments.endpoints_px[rows].astype(np.float64), observed[rows], covariance[rows], sigma_px, memory,
    )  # fmt: skip
    endpoints, information = extend_lines(endpoints, information, transform(view.T_world_camera, observed[rows]))
    table = table.updated(
        ids, endpoints_m=endpoints, information=information, descriptor=segments.descriptors[rows], **_update_observation(table, ids, view.keyframe)
    )
    local = observed[new]
    R, total = view.T_world_camera[:3, :3], covariance[new] + propagate_pose_covariance(local, view.covariance)
    table, created = table.appended(
        endpoints_m=transform(view.T_world_camera, local),
        information=inv_symmetric(matmul(R, total, R.T)),
        descriptor=segments.descriptors[new],
        **_new_landmark(len(new), view.keyframe),
    )
    measured = _rows(segments, np.concatenate([rows, new]), "endpoints_px", "endpoints_m", "covariance_m2")
    return _append_observations(replace(map, lines=table), LINE, view.keyframe, np.concatenate([ids, created]), measured)


def extend_lines(endpoints: F64, information: F32 | F64, observed: F64) -> tuple[F64, F64]:
    """Extend lines (n, 2, 3) along their direction to the observed ends (n, 2, 3; NaN = unknown); also returns their information."""
    share = parameters_on(endpoints, observed)
    reach = np.stack([np.fmin(share.min(axis=1), 0.0), np.fmax(share.max(axis=1), 1.0)], axis=1)
    points, covariance = points_along(endpoints, inv_symmetric(information), reach)
    return points, inv_symmetric(covariance)


def insert_planes(map: Map, view: Observations, planes: Planes, pairs: I32, new: I32, memory: float) -> Map:
    """Re-estimate the planes `pairs` (row, id) from their summed moments and make landmarks of the rows `new`."""
    T = view.T_world_camera
    moments = move_moments(T, equivalent_moments(planes.coefficients, _plane_covariance(planes, view)))
    samples = transform(T, planes.samples_m.astype(np.float64)).astype(np.float32)
    table = map.planes
    ids, where = np.unique(pairs[:, 1], return_inverse=True)
    total = table.rows("moments", ids) * (1.0 - 1.0 / memory)
    np.add.at(total, where, moments[pairs[:, 0]])
    fitted, covariance = fit_planes(total, table.rows("coefficients", ids))
    spread = [farthest_samples(np.concatenate([old, *samples[pairs[where == k, 0]]]), len(old)) for k, old in enumerate(table.rows("samples_m", ids))]
    table = table.updated(
        ids,
        coefficients=fitted,
        covariance=covariance,
        moments=total,
        samples_m=project_to_planes(np.array(spread, np.float32).reshape(-1, *table.schema["samples_m"].shape), fitted),
        **_update_observation(table, ids, view.keyframe),
    )
    fitted, covariance = fit_planes(moments[new], transform_planes(T, planes.coefficients[new]))
    table, created = table.appended(
        coefficients=fitted,
        covariance=covariance,
        moments=moments[new],
        samples_m=project_to_planes(samples[new], fitted),
        **_new_landmark(len(new), view.keyframe),
    )
    measured = _rows(planes, np.concatenate([pairs[:, 0], new]), "coefficients", "covariance", "moments")
    return _append_observations(replace(map, planes=table), PLANE, view.keyframe, np.concatenate([pairs[:, 1], created]), measured)


def _plane_covariance(planes: Planes, view: Observations) -> F64:
    """Covariance (n, 3, 3) of observed planes, that of the camera pose included."""
    B = tangent_basis(planes.coefficients[:, :3])
    J = np.zeros((len(B), 3, 6))
    n = planes.coefficients[:, :3]
    J[:, :2, 3:] = np.stack([np.cross(n, B[..., 0]), np.cross(n, B[..., 1])], axis=1)
    J[:, 2, :3] = n
    return np.asarray(planes.covariance + matmul(J, view.covariance, np.swapaxes(J, -1, -2)))
