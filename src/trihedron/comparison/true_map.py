"""The map of a run as it would be with true keyframe poses: every row stays, its geometry moves.

Topics after the map name its rows, so a map that is built again from true poses cannot take its place: its row 7 is another landmark. Here each
keyframe takes its true pose, and each landmark moves as the keyframes that observed it do, on average. A landmark is the mean of what its keyframes
measured, so that this is, to first order, the mean of the same measurements from true poses: what remains of its error is measurement noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, transform_each
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Map, Table
from trihedron.plugins.mapping.plane_fusion import motions_between
from trihedron.plugins.shared.covariances import transform_plane_covariance


def true_map(map: Map, poses: Mapping[int, F64]) -> Map:
    """Return the map with the geometry that true poses (4, 4) of frames, by stamp, give its rows; the same rows, ids, observations and revision.

    A keyframe without a true pose moves with the nearest one, in order of time, that has one. Sub-maps are all in the world of the poses, so that
    they are one. The map is unchanged when no keyframe has a true pose."""
    motions = keyframe_motions(map.keyframes, poses)
    if motions is None:
        return map
    ids = np.arange(len(map.keyframes), dtype=np.int32)
    T_world = matmul(motions, map.keyframes.column("T_world_camera"))
    known = [(row, poses[stamp]) for row, stamp in enumerate(map.keyframes.column("stamp_ns").tolist()) if stamp in poses]
    T_world[[row for row, _ in known]] = [T for _, T in known]
    keyframes = map.keyframes.updated(ids, T_world_camera=T_world, submap=np.zeros(len(ids), np.int32))
    return replace(
        map, keyframes=keyframes, points=_points(map.points, motions), lines=_lines(map.lines, motions), planes=_planes(map.planes, motions)
    )


def keyframe_motions(keyframes: Table, poses: Mapping[int, F64]) -> F64 | None:
    """Return the motion (k, 4, 4), in the world, that takes each keyframe to its true pose; None when none has one."""
    stamps, T_world = keyframes.column("stamp_ns"), keyframes.column("T_world_camera")
    known = np.array([row for row, stamp in enumerate(stamps.tolist()) if stamp in poses], np.int64)
    if not len(known):
        return None
    motions = matmul(np.array([poses[int(stamp)] for stamp in stamps[known]]), invert(T_world[known]))
    nearest = np.abs(stamps[:, None] - stamps[known]).argmin(axis=1)
    return np.asarray(motions[nearest])


def mean_motions(table: Table, ids: I32, motions: F64) -> F64:
    """Return the mean (n, 4, 4) of the motions of the keyframes that observed each landmark, of the one that made it where none is remembered.

    Applied to a point this is the mean of where the motions take it. Its rotation is shortened by what the motions differ in, squared."""
    observers, first = table.columns_at(ids, "observers", "first")
    seen = observers >= 0
    observers = np.where(seen, observers, first[:, None])
    weights = np.where(seen.any(axis=1, keepdims=True), seen, 1.0)
    return np.asarray(np.einsum("nk,nkij->nij", weights / weights.sum(axis=1)[:, None], motions[observers]))


def _living(table: Table) -> I32:
    return np.flatnonzero(table.column("alive")).astype(np.int32)


def _points(table: Table, motions: F64) -> Table:
    ids = _living(table)
    M = mean_motions(table, ids, motions)
    position, information, direction = table.columns_at(ids, "position_m", "information", "direction")
    moved = transform_each(M, position[:, None])[:, 0]
    return table.updated(
        ids, position_m=moved, information=_rotate_information(M, information), direction=_rotate_directions(M, direction[:, None])[:, 0]
    )


def _lines(table: Table, motions: F64) -> Table:
    ids = _living(table)
    M = mean_motions(table, ids, motions)
    ends, information = table.columns_at(ids, "endpoints_m", "information")
    return table.updated(ids, endpoints_m=transform_each(M, ends), information=_rotate_information(M[:, None], information))


def _planes(table: Table, motions: F64) -> Table:
    """Planes whose normals take the mean direction, and whose centres keep their distance from them."""
    ids = _living(table)
    M = mean_motions(table, ids, motions)
    old, covariance, moments, samples = table.columns_at(ids, "coefficients", "covariance", "moments", "samples_m")
    centres = moments[:, :3, 3] / moments[:, 3, 3:]
    moved = transform_each(M, centres[:, None])[:, 0]
    new = np.empty_like(old)
    normals = _rotate_directions(M, old[:, None, :3])[:, 0]
    new[:, :3] = normals / np.linalg.norm(normals, axis=1)[:, None]
    new[:, 3] = old[:, 3] + np.einsum("ni,ni->n", old[:, :3], centres) - np.einsum("ni,ni->n", new[:, :3], moved)
    T = motions_between(old, new, centres)
    for row in range(len(ids)):
        one = slice(row, row + 1)
        covariance[one] = transform_plane_covariance(T[row], old[one], new[one], covariance[one])
    moments = matmul(T, moments, np.swapaxes(T, 1, 2))
    return table.updated(ids, coefficients=new, covariance=covariance, moments=moments, samples_m=transform_each(T, samples))


def _rotate_directions(M: F64, directions: NDArray[np.floating]) -> F64:
    """Directions (n, k, 3), each row by the rotation of its own (n, 4, 4)."""
    return np.asarray(matmul(directions, np.swapaxes(M[:, :3, :3], 1, 2)))


def _rotate_information(M: F64, information: NDArray[np.floating]) -> F64:
    R = M[..., :3, :3]
    return np.asarray(R @ information @ np.swapaxes(R, -1, -2))
