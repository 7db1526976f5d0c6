"""Merging of duplicate landmarks: points, lines and planes that are one and the same. The older id remains."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.linalg import inv_symmetric, matmul, solve
from trihedron.pipeline.core.types import I32, Bool, Map, Table
from trihedron.plugins.mapping.covisibility_graph import newest_keyframes, observed_by
from trihedron.plugins.mapping.insertion import Observations, extend_lines
from trihedron.plugins.mapping.landmark_kernels import farthest_samples
from trihedron.plugins.mapping.landmark_kinds import LINE, PLANE, POINT, LandmarkKind, landmarks_of, observations_of, observed_rows, with_tables
from trihedron.plugins.mapping.landmarks import OBSERVERS, isin, newest_first, remove_rows
from trihedron.plugins.mapping.plane_fusion import fit_planes, project_to_planes
from trihedron.plugins.mapping.projection import clip_segments, parameters_on, points_along
from trihedron.plugins.shared.feature_matching import match_lines, match_near
from trihedron.plugins.shared.feature_matching_kernels import mean_distance, overlap
from trihedron.plugins.shared.pose_optimizer_kernels import CHI2_95

NEAR_PX = 3.0  # between the projections of duplicates
MAX_BITS, MAX_L2 = 50, 150  # between their descriptors, as for a strict match (ORB-SLAM2: 50)
LINE_DEG, LINE_OVERLAP, LINE_BITS = 2.0, 0.3, 60


def merge_points(map: Map, view: Observations, visible: I32, metric: str) -> Map:
    """Merge points expected by this keyframe but not matched with those it observed, where pixel, descriptor and position agree."""
    seen = observed_by(map, np.array([view.keyframe], np.int32), POINT)
    unmatched = visible[map.points.rows("alive", visible) & ~isin(visible, seen)]
    sides = []
    for ids in (unmatched, seen):
        position, descriptors, octaves = map.points.columns_at(ids, "position_m", "descriptor", "octave")
        pixels = view.camera.project(transform(invert(view.T_world_camera), position)).astype(np.float32)
        sides.append((pixels, descriptors, octaves))
    limit = MAX_BITS if metric == "hamming" else MAX_L2
    found = match_near(*sides[0], *sides[1], np.full(len(unmatched), NEAR_PX, np.float32), 1, limit, 1.0, metric)
    pairs = np.stack([unmatched[found >= 0], seen[found[found >= 0]]], axis=-1)
    if not len(pairs):
        return map
    position, information = map.points.columns_at(pairs.ravel(), "position_m", "information")
    position, information = position.reshape(-1, 2, 3), information.reshape(-1, 2, 3, 3).astype(np.float64)
    apart = position[:, 1] - position[:, 0]
    covariance = inv_symmetric(information).sum(axis=1)
    same: Bool = np.einsum("ni,nij,nj->n", apart, inv_symmetric(covariance), apart) <= CHI2_95[3]
    pairs, position, information = pairs[same], position[same], information[same]
    total = information.sum(axis=1)
    merged = solve(total, np.einsum("nkij,nkj->ni", information, position)[..., None])[..., 0]
    kept, gone = pairs.min(axis=1), pairs.max(axis=1)
    names = ("descriptor", "direction", "distance_m", "octave")
    newer: dict[str, Any] = dict(zip(names, map.points.columns_at(pairs[:, 1], *names)))
    points = map.points.updated(kept, position_m=merged, information=0.5 * total, **newer)  # half: both contain some of the same observations
    return _remove_merged(replace(map, points=points), POINT, kept, gone)


def merge_lines(map: Map, view: Observations, visible: I32) -> Map:
    """Merge lines expected by this keyframe but not matched with those it observed, where image, descriptor and position agree."""
    seen = observed_by(map, np.array([view.keyframe], np.int32), LINE)
    unmatched = visible[map.lines.rows("alive", visible) & ~isin(visible, seen)]
    sides = []
    for ids in (unmatched, seen):
        pixels, inside = clip_segments(map.lines.rows("endpoints_m", ids), invert(view.T_world_camera), view.camera)
        pixels[~inside] = np.nan
        sides.append((pixels.astype(np.float32), map.lines.rows("descriptor", ids)))
    found = match_lines(*sides[0], *sides[1], LINE_DEG, NEAR_PX, LINE_OVERLAP, LINE_BITS, 1.0)
    pairs = np.sort(np.stack([unmatched[found >= 0], seen[found[found >= 0]]], axis=-1), axis=1)
    pairs = pairs[_collinear(map.lines, pairs[:, 0], pairs[:, 1])] if len(pairs) else pairs
    if not len(pairs):
        return map
    kept, gone = pairs[:, 0], pairs[:, 1]
    reach, descriptor = map.lines.columns_at(gone, "endpoints_m", "descriptor")
    endpoints, information = map.lines.columns_at(kept, "endpoints_m", "information")
    endpoints, information = extend_lines(endpoints, information, reach)
    lines = map.lines.updated(kept, endpoints_m=endpoints, information=information, descriptor=descriptor)
    return _remove_merged(replace(map, lines=lines), LINE, kept, gone)


def _collinear(lines: Table, a: I32, b: I32) -> Bool:
    """Return True (n,) where both ends of line b lie on line a within their uncertainty (χ² test)."""
    (on, known), (ends, other) = (lines.columns_at(ids, "endpoints_m", "information") for ids in (a, b))
    foot, covariance = points_along(on, inv_symmetric(known), parameters_on(on, ends))
    covariance += inv_symmetric(other)
    chi2 = np.einsum("nki,nkij,nkj->nk", ends - foot, inv_symmetric(covariance), ends - foot)
    good: Bool = (chi2 <= CHI2_95[2]).all(axis=1)
    return good


def merge_planes(map: Map, keyframe: int, max_deg: float, max_m: float) -> Map:
    """Merge planes observed by this keyframe with duplicates observed by the newest few."""
    fresh = observed_by(map, np.array([keyframe], np.int32), PLANE)
    around = observed_by(map, newest_keyframes(map, 5), PLANE)
    is_fresh, parallel = isin(around, fresh), _parallel(map.planes, around, max_deg)
    for k in range(len(around) - 1, 0, -1):
        older = parallel[k, :k] if is_fresh[k] else parallel[k, :k] & is_fresh[:k]
        merged = _merge_with_first(map, around[:k][older], int(around[k]), max_m)
        if merged is not map:
            map, parallel = merged, _parallel(merged.planes, around, max_deg)
    return map


def fuse_planes(map: Map, older: I32, newer: I32, max_deg: float, max_m: float) -> Map:
    """Merge each of the planes `newer` with the first duplicate among the planes `older`, both given by id."""
    for b in newer.tolist():
        parallel = _parallel(map.planes, np.append(older, b), max_deg)[-1, :-1]
        map = _merge_with_first(map, older[parallel], b, max_m)
    return map


def _parallel(planes: Table, ids: I32, max_deg: float) -> Bool:
    """(n, n) True for planes with the same normal."""
    normals = planes.rows("coefficients", ids)[:, :3]
    parallel: Bool = matmul(normals, normals.T) >= np.cos(np.radians(max_deg))
    return parallel


def _merge_with_first(map: Map, others: I32, plane: int, max_m: float) -> Map:
    """Merge a plane with its first duplicate among the others, which have the same normal."""
    for other in others.tolist():
        if _is_duplicate(map.planes, min(other, plane), max(other, plane), max_m):
            return _merge_pair(map, min(other, plane), max(other, plane))
    return map


def _is_duplicate(planes: Table, a: int, b: int, max_m: float) -> bool:
    """Return True if two living planes with the same normal lie within `max_m` of each other on average, both ways, and overlap."""
    ids = np.array([a, b], np.int32)
    alive, coefficients, samples = planes.columns_at(ids, "alive", "coefficients", "samples_m")
    if not alive.all():
        return False
    apart = max(mean_distance(coefficients[0], samples[1]), mean_distance(coefficients[1], samples[0]))
    return apart < max_m and max(overlap(samples[0], samples[1], 0.3), overlap(samples[1], samples[0], 0.3)) > 0.3


def _merge_pair(map: Map, a: int, b: int) -> Map:
    """Merge the moments, samples and observations of plane b into plane a."""
    ids = np.array([a, b], np.int32)
    table = map.planes
    moments = table.rows("moments", ids).sum(axis=0)[None]
    fitted, covariance = fit_planes(moments, table.rows("coefficients", ids[:1]))
    samples = table.rows("samples_m", ids)
    spread = farthest_samples(samples.reshape(-1, 3), samples.shape[1])
    table = table.updated(ids[:1], coefficients=fitted, covariance=covariance, moments=moments, samples_m=project_to_planes(spread[None], fitted))
    return _remove_merged(replace(map, planes=table), PLANE, ids[:1], ids[1:])


def _remove_merged(map: Map, kind: LandmarkKind, kept: I32, gone: I32) -> Map:
    """Remove the landmarks `gone`; their observers, counts and observations pass to the distinct ids `kept`."""
    table = landmarks_of(map)[kind]
    mine, theirs = (table.columns_at(ids, "observers", "found", "visible") for ids in (kept, gone))
    both = newest_first(np.concatenate([mine[0], theirs[0]], axis=1))
    both[:, 1:][both[:, 1:] == both[:, :-1]] = -1  # observed by the same keyframe
    table = table.updated(
        kept, observers=newest_first(both)[:, :OBSERVERS], found=np.maximum(mine[1], theirs[1]), visible=np.maximum(mine[2], theirs[2])
    )
    return with_tables(map, {kind: remove_rows(table, gone)}, {kind: _replace_ids(map, kind, kept, gone)})


def _replace_ids(map: Map, kind: LandmarkKind, kept: I32, gone: I32) -> Table:
    """Replace the ids `gone` by `kept` in the observations of their observers."""
    observations, observers = observations_of(map)[kind], np.unique(landmarks_of(map)[kind].rows("observers", gone))
    rows, ids, _ = observed_rows(map, observers[observers >= 0], kind)
    order = np.argsort(gone)
    place = np.minimum(np.searchsorted(gone[order], ids), max(len(gone) - 1, 0))
    hit = gone[order][place] == ids if len(gone) else np.zeros(len(ids), np.bool_)
    return observations.updated(rows[hit], **{kind.id_column: kept[order][place[hit]]})
