"""What a bundle adjustment found, as a correction of the map."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, tangent_basis, transform_planes
from trihedron.pipeline.core.types import F64, I32, Correction, Map
from trihedron.plugins.numerics.algebra.uncertainty import inverse, transform_plane_covariance
from trihedron.plugins.numerics.bundle.bundle_problem import BundleMeasurements, BundleState, BundleWindow
from trihedron.plugins.numerics.bundle.bundle_solver import BundleSolution
from trihedron.plugins.numerics.maps.landmarks import ENDS, PLACE


def bundle_correction(map: Map, window: BundleWindow, found: BundleSolution) -> Correction:
    """The window's keyframes and landmarks with the marginal information that all measurements of the window leave, poses uncertain too: later ones
    are fused on top of it, and the next adjustment begins again from the measurements themselves."""
    state, free, n = found.state, len(window.free), len(window.points)
    poses = np.tile(np.eye(4), (free, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = state.rotations[:free], state.positions[:free]
    points, ends = found.landmark_covariance[:n, :3, :3], _ends(map, window, state.lines, found.landmark_covariance[n:])
    planes = [found.covariance[i : i + 3, i : i + 3] for i in range(6 * free, len(found.covariance), 3)]
    return Correction(
        index=map.index,
        stamp_ns=map.stamp_ns,
        based_on=map.revision,
        keyframe_ids=window.free,
        T_world_keyframe=poses,
        point_ids=window.points,
        points_m=PLACE.rounded(state.points),
        point_information=_symmetric(inverse(points)).astype(np.float32),
        line_ids=window.lines,
        endpoints_m=ENDS.rounded(state.lines),
        line_information=_symmetric(inverse(ends)).astype(np.float32),
        plane_ids=window.planes,
        coefficients=state.planes,
        plane_covariance=_symmetric(np.array(planes, np.float64).reshape(-1, 3, 3)),
    )


def carried_correction(map: Map, window: BundleWindow, seen: BundleMeasurements, state: BundleState) -> Correction:
    """The window's keyframes and points where a state has them, known as well as the map knew them. Lines, planes and points that the state left in
    their places go with the newest free keyframe that saw them."""
    free = len(window.free)
    poses = np.tile(np.eye(4), (free, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = state.rotations[:free], state.positions[:free]
    motions = poses @ invert(map.keyframes.rows("T_world_camera", window.free))
    by = [np.repeat(np.arange(len(starts) - 1), np.diff(starts)) for starts in (seen.point_starts, seen.line_starts)]
    T_point, T_line, T_plane = (
        motions[_newest_free(rows, who, count, free)]
        for rows, who, count in (
            (by[0], seen.point_keyframes, len(window.points)),
            (by[1], seen.line_keyframes, len(window.lines)),
            (seen.plane_rows, seen.plane_keyframes, len(window.planes)),
        )
    )
    old = map.points.rows("position_m", window.points)
    still = (state.points == old).all(axis=1)
    points = np.where(still[:, None], _moved(T_point, old[:, None])[:, 0], state.points)
    planes = map.planes.rows("coefficients", window.planes)
    moved = [transform_planes(T, plane[None])[0] for T, plane in zip(T_plane, planes)]
    covariance = map.planes.rows("covariance", window.planes)
    turned = [transform_plane_covariance(T, a[None], b[None], C[None])[0] for T, a, b, C in zip(T_plane, planes, moved, covariance)]
    R, Q = T_point[:, :3, :3], T_line[:, None, :3, :3]
    return Correction(
        index=map.index,
        stamp_ns=map.stamp_ns,
        based_on=map.revision,
        keyframe_ids=window.free,
        T_world_keyframe=poses,
        point_ids=window.points,
        points_m=PLACE.rounded(points),
        point_information=(R @ map.points.rows("information", window.points) @ np.swapaxes(R, -1, -2)).astype(np.float32),
        line_ids=window.lines,
        endpoints_m=ENDS.rounded(_moved(T_line, map.lines.rows("endpoints_m", window.lines))),
        line_information=(Q @ map.lines.rows("information", window.lines) @ np.swapaxes(Q, -1, -2)).astype(np.float32),
        plane_ids=window.planes,
        coefficients=np.array(moved, np.float64).reshape(-1, 4),
        plane_covariance=np.array(turned, np.float64).reshape(-1, 3, 3),
    )


def _newest_free(rows: I32, keyframes: I32, count: int, free: int) -> I32:
    """(count,) the newest free keyframe among those, `keyframes`, that saw each landmark, `rows`; every one was seen by some."""
    newest = np.zeros(count, np.int32)
    known = keyframes < free
    np.maximum.at(newest, rows[known], keyframes[known])
    return newest


def _moved(T: F64, points: F64) -> F64:
    """Points (n, e, 3), each row by its own motion (n, 4, 4)."""
    return np.asarray(points @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3], np.float64)


def _ends(map: Map, window: BundleWindow, lines: F64, covariance: F64) -> F64:
    """(m, 2, 3, 3) covariance of the ends of lines (m, 2, 3): that found across them, (m, 4, 4), and along them what the map knew, for only where a
    line is was adjusted, not where it ends."""
    direction = lines[:, 1] - lines[:, 0]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    known = inverse(map.lines.rows("information", window.lines))
    along = np.einsum("mi,meij,mj->me", direction, known, direction)
    N = tangent_basis(direction)
    across = np.stack([covariance[:, :2, :2], covariance[:, 2:, 2:]], axis=1)
    return N[:, None] @ across @ np.swapaxes(N, -1, -2)[:, None] + along[..., None, None] * (direction[:, :, None] * direction[:, None, :])[:, None]


def _symmetric(matrices: F64) -> F64:
    return 0.5 * (matrices + np.swapaxes(matrices, -1, -2))
