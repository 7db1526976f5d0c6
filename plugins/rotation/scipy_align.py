"""The camera's rotation from tracked directions by SciPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import eigvalsh, inv, matmul
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Keypoints, Map, Planes, Pose, Rotation, Segments, Tracks
from trihedron.plugins.mapping.reference_keyframe import transform_rotation_to_map
from trihedron.plugins.rotation.estimate import Estimate, rotation_before, rotation_value
from trihedron.plugins.rotation.known_frames import KnownFrames
from trihedron.plugins.shared.rigid_alignment import tracked_point_pairs


@register("rotation", "scipy_align")
@dataclass(frozen=True)
class ScipyAlign:
    """`scipy.spatial.transform.Rotation.align_vectors` (Kabsch, 1976; Wahba's problem) of the tracked normals of planes, directions of lines, and
    points about their mean, each weighted by its variance.

    Least squares without a robust cost: it relies on the outlier rejection of `tracks`. Library: SciPy (BSD). Its 3 × 3 singular value decomposition
    is LAPACK's: the bytes may differ on another CPU."""

    pose_floor_deg: PositiveFloat = 0.1  # least error of the previous pose
    plane_floor_deg: PositiveFloat = 0.3  # least error of a tracked plane's normal
    held_deg: PositiveFloat = 2.0  # error of a rotation that is held, per frame
    measured_deg: PositiveFloat = 1.0  # a rotation less certain than this is held

    def __call__(
        self, tracks: Tracks | None, keypoints: Keypoints, segments: Segments, planes: Planes, previous: Rotation | None, previous_pose: Pose | None,
        map: Map | None,
    ) -> Rotation:  # fmt: skip
        """Return the rotation of this frame; the identity for the first."""
        estimate = Estimate(np.eye(3), np.zeros((3, 3)), "prediction")
        if previous is not None:
            before, _ = rotation_before(*transform_rotation_to_map(previous, previous_pose, map), self.pose_floor_deg)
            gap = max(keypoints.index - previous.index, 1)
            estimate = Estimate(before.R, before.covariance + np.eye(3) * np.radians(self.held_deg * gap) ** 2, "prediction")
            if tracks is not None and tracks.previous_index == previous.index:
                vectors = tracked_vectors(tracks, keypoints, segments, planes, np.radians(self.plane_floor_deg))
                estimate = self._align_vectors(before, *vectors) or estimate
        return rotation_value(keypoints.index, keypoints.stamp_ns, estimate, KnownFrames.none(), np.zeros((0, 3, 3)))

    def _align_vectors(self, before: Estimate, then: F64, now: F64, sigma: F64) -> Estimate | None:
        """The previous rotation with that of the vectors on top; None where these leave some axis less certain than `measured_deg`."""
        from scipy.spatial.transform import Rotation as Aligned

        information = np.einsum("n,nij->ij", sigma**-2.0, _squared_cross(now))
        if eigvalsh(information)[0] <= np.radians(self.measured_deg) ** -2.0:
            return None
        R = Aligned.align_vectors(now, then, weights=sigma**-2.0)[0].as_matrix()
        return Estimate(matmul(before.R, R.T), matmul(R, before.covariance, R.T) + inv(information), "tracks")


def _squared_cross(vectors: F64) -> F64:
    """`[v]×ᵀ [v]×` (n, 3, 3): how far each vector moves with a small rotation."""
    return np.asarray((vectors**2).sum(axis=1)[:, None, None] * np.eye(3) - vectors[:, :, None] * vectors[:, None, :])


def tracked_vectors(tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, floor_rad: float) -> tuple[F64, F64, F64]:
    """Vectors (n, 3) of the previous and of the current frame that differ by the rotation alone, and the σ (n,) of their difference."""
    before, after, sigma = _usable(*tracked_point_pairs(tracks, keypoints))
    if len(before):
        weight = sigma**-2.0 / (sigma**-2.0).sum()
        before, after = before - matmul(weight, before), after - matmul(weight, after)
    j = tracks.planes[:, 1]
    tilt = tracks.plane_covariance[:, :2, :2] + planes.covariance[j][:, :2, :2]
    normals = tracks.coefficients[:, :3], planes.coefficients[j, :3], np.sqrt(0.5 * np.trace(tilt, axis1=1, axis2=2) + floor_rad**2)
    lines = _line_directions(tracks, segments)
    parts = [[before, normals[0], lines[0]], [after, normals[1], lines[1]], [sigma, normals[2], lines[2]]]
    return _usable(*(np.concatenate(part).astype(np.float64) for part in parts))


def _usable(then: F64, now: F64, sigma: F64) -> tuple[F64, F64, F64]:
    """Rows whose numbers are all finite and whose σ is positive."""
    rows = np.isfinite(then).all(axis=1) & np.isfinite(now).all(axis=1) & np.isfinite(sigma) & (sigma > 0.0)
    return then[rows], now[rows], sigma[rows]


def _line_directions(tracks: Tracks, segments: Segments) -> tuple[F64, F64, F64]:
    """Unit directions (m, 3) of the tracked lines with depth in both frames, and the σ (m,) of their difference."""
    rows = tracks.segments[:, 1]
    then = np.diff(tracks.endpoints_m, axis=1)[:, 0].astype(np.float64)
    now = np.diff(segments.endpoints_m[rows], axis=1)[:, 0].astype(np.float64)
    both = np.isfinite(then).all(axis=1) & np.isfinite(now).all(axis=1)
    then, now, rows = then[both], now[both], rows[both]
    spread = np.trace(segments.covariance_m2[rows].astype(np.float64).sum(axis=1), axis1=1, axis2=2)
    lengths = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
    long = (lengths[0] > 1e-3) & (lengths[1] > 1e-3) & np.isfinite(spread)
    then, now = then[long] / lengths[0][long, None], now[long] / lengths[1][long, None]
    sign = np.sign((matmul(then, tracks.R_current_previous.T) * now).sum(axis=1))
    return then, now * np.where(sign < 0.0, -1.0, 1.0)[:, None], np.sqrt(2.0 * spread[long]) / lengths[1][long] + 1e-3
