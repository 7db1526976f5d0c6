"""The correction of a map whose keyframes move: landmarks follow their observers."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform_each
from trihedron.pipeline.core.linalg import inv_symmetric, matmul
from trihedron.pipeline.core.types import F32, F64, I32, Correction, Map, Table
from trihedron.plugins.mapping.landmarks import ENDPOINTS, POSITION
from trihedron.plugins.mapping.plane_fusion import information_of


def correct_keyframes(map: Map, rows: I32, before: F64, after: F64) -> Correction:
    """Return the correction that moves keyframes `rows` from poses (n, 4, 4) to others, and each landmark by the mean motion of its observers."""
    motions = np.broadcast_to(np.eye(4), (len(map.keyframes), 4, 4)).copy()
    motions[rows] = matmul(after, invert(before))
    (points, T_points), (lines, T_lines), (planes, T_planes) = (_mean_motion(table, motions) for table in (map.points, map.lines, map.planes))
    coefficients = _transform_planes(T_planes, map.planes.rows("coefficients", planes))
    moments = matmul(T_planes, map.planes.rows("moments", planes), np.swapaxes(T_planes, 1, 2))
    return Correction(
        map.index, map.stamp_ns, map.revision, rows, after,
        points, POSITION.rounded(transform_each(T_points, map.points.rows("position_m", points)[:, None])[:, 0]),
        _rotate_information(T_points, map.points.rows("information", points)),
        lines, ENDPOINTS.rounded(transform_each(T_lines, map.lines.rows("endpoints_m", lines))),
        _rotate_information(T_lines[:, None], map.lines.rows("information", lines)),
        planes, coefficients, inv_symmetric(information_of(moments, coefficients)),
    )  # fmt: skip


def _mean_motion(table: Table, motions: F64) -> tuple[I32, F64]:
    """Living landmarks (n,) and the mean (n, 4, 4) of the motions (k, 4, 4) of each one's observers; between similar motions it is rigid."""
    ids = np.flatnonzero(table.column("alive")).astype(np.int32)
    total, count = np.zeros((len(ids), 4, 4)), np.zeros(len(ids))
    for column in table.rows("observers", ids).T:
        known = column >= 0
        total[known] += motions[column[known]]
        count += known
    total[count == 0.0], count[count == 0.0] = np.eye(4), 1.0
    return ids, total / count[:, None, None]


def _rotate_information(T: F64, information: F32) -> F32:
    """Rotate information matrices (..., 3, 3) by motions (..., 4, 4)."""
    return np.asarray(matmul(T[..., :3, :3], information, np.swapaxes(T[..., :3, :3], -1, -2)), np.float32)


def _transform_planes(T: F64, planes: F64) -> F64:
    """Transform planes (n, 4), each by its own motion (n, 4, 4)."""
    n = matmul(T[:, :3, :3], planes[:, :3, None])[..., 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.concatenate([n, planes[:, 3:] - np.einsum("ni,ni->n", n, T[:, :3, 3])[:, None]], axis=1)
