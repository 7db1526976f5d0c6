"""Position with the rotation fixed: the paper's cost by SciPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.linalg import eigh, inv, matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Map, Planes, Pose, Rotation, Segments, Tracks, Translation
from trihedron.plugins.mapping.reference_keyframe import transform_to_map
from trihedron.plugins.translation.predicted_position import origin, predicted_translation, propagated_covariance

NEAR_M = 0.05  # nearer to the image plane than this a point is not projected
GATE = 3.0  # standard deviations within which a feature is an inlier


@register("translation", "scipy_least_squares")
@dataclass(frozen=True)
class ScipyLeastSquares:
    """The cost of the paper (eqs. 2–7), written once as a reader would: `scipy.optimize.least_squares` over the translation, with Huber's loss.

    It is the reference that `levenberg_marquardt` is tested against. Points of the previous frame are reprojected (eq. 2), ends of its lines are to
    lie on the observed lines (eqs. 3 and 4), and distances to its planes are to be those observed (eqs. 5 and 6: with the rotation fixed the angles
    of a normal do not depend on the translation). Each residual is divided by its standard deviation. No motion is a weak prior.

    Library: SciPy (BSD). Its solver calls LAPACK: the bytes may differ on another CPU."""

    huber: PositiveFloat = 2.448  # standard deviations beyond which the cost is linear: √5.991, the 95 % quantile of ORB-SLAM
    line_sigma_px: PositiveFloat = 1.0  # of the distance of an end from a line
    plane_floor_m: PositiveFloat = 0.002  # least σ of the distance to a plane
    motion_sigma_m: PositiveFloat = 0.1  # of no motion, per frame
    evaluations: PositiveInt = 100  # max_nfev

    def __call__(
        self, camera: Camera, rotation: Rotation, tracks: Tracks | None, keypoints: Keypoints, segments: Segments, planes: Planes,
        previous_pose: Pose | None, map: Map | None,
    ) -> Translation:  # fmt: skip
        """Return the position; the first frame's is the origin of the world."""
        if previous_pose is None:
            return origin(rotation)
        pose = transform_to_map(previous_pose, map)
        T, R, propagated = pose.T_world_camera, rotation.R_world_camera, propagated_covariance(pose, held_too=True)
        prior_m = self.motion_sigma_m * max(rotation.index - pose.index, 1)
        if tracks is None or tracks.previous_index != pose.index:
            return predicted_translation(rotation, T[:3, 3].copy(), propagated + prior_m**2 * np.eye(3))
        terms = tracked_terms(tracks, keypoints, segments, planes, matmul(R.T, T[:3, :3]), self.line_sigma_px, self.plane_floor_m)
        found = self._solve_problem(terms, camera, prior_m)
        if not found.inliers.any():
            return predicted_translation(rotation, T[:3, 3].copy(), propagated + prior_m**2 * np.eye(3))
        held = np.ascontiguousarray(matmul(found.unobservable, R.T))
        covariance = matmul(R, found.covariance, R.T) + propagated
        return Translation(rotation.index, rotation.stamp_ns, T[:3, 3] - matmul(R, found.s), covariance, held, found.inliers, True)

    def _solve_problem(self, terms: Terms, camera: Camera, prior_m: float) -> Solved:
        from scipy.optimize import least_squares

        count = sum(map(len, residuals(terms, camera, np.zeros(3))))

        def cost(s: F64) -> F64:
            return np.concatenate([*map(np.ravel, residuals(terms, camera, s)), s / prior_m])

        found = least_squares(cost, np.zeros(3), loss="huber", f_scale=self.huber, method="trf", max_nfev=self.evaluations)
        J = found.jac[:-3] if count else np.zeros((0, 3))  # of the data, weighted by the loss
        information = matmul(J.T, J)
        values, vectors = eigh(information)
        agreeing = [np.count_nonzero((np.abs(r) < GATE).all(axis=1)) for r in residuals(terms, camera, found.x)]
        covariance = inv(information + np.eye(3) / prior_m**2)
        return Solved(found.x, covariance, vectors[:, values < prior_m**-2.0].T, np.array(agreeing, np.int32))


class Solved(NamedTuple):
    """Translation s (3,) in `p_current = R p_previous + s` with covariance (3, 3), unit vectors (u, 3) that no feature observes, and the number of
    points, lines and planes that agree."""

    s: F64
    covariance: F64
    unobservable: F64
    inliers: np.ndarray


class Terms(NamedTuple):
    """Features of the previous frame rotated into the current camera's axes, what is observed of them, and standard deviations."""

    points_m: F64  # (n, 3)
    pixels: F64  # (n, 2)
    point_sigma_px: F64  # (n,)
    endpoints_m: F64  # (m, 2, 3)
    lines: F64  # (m, 3) a u + b v + c = 0 with a² + b² = 1, pixels
    line_sigma_px: float
    normals: F64  # (p, 3)
    distances_m: F64  # (p,) in the previous frame
    observed_m: F64  # (p,) in the current one
    plane_sigma_m: F64  # (p,)


def tracked_terms(tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, R: F64, line_sigma_px: float, floor_m: float) -> Terms:
    """Collect the tracked features with depth in the previous frame; R (3, 3) is R_current_previous."""
    deep = np.isfinite(tracks.points_m).all(axis=1)
    rows, whole = tracks.keypoints[deep, 1], np.isfinite(tracks.endpoints_m).all(axis=(1, 2))
    ends = segments.endpoints_px[tracks.segments[whole, 1]].astype(np.float64)
    lines = np.cross(np.insert(ends[:, 0], 2, 1.0, axis=1), np.insert(ends[:, 1], 2, 1.0, axis=1))  # eq. 3
    walls = tracks.planes[:, 1]
    variance = tracks.plane_covariance[:, 2, 2] + planes.covariance[walls, 2, 2]
    return Terms(
        matmul(tracks.points_m[deep].astype(np.float64), R.T),
        keypoints.pixels[rows].astype(np.float64),
        keypoints.sigma_px[rows].astype(np.float64),
        matmul(tracks.endpoints_m[whole].astype(np.float64), R.T),
        lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-9)[:, None],
        line_sigma_px,
        matmul(tracks.coefficients[:, :3], R.T),
        tracks.coefficients[:, 3],
        planes.coefficients[walls, 3],
        np.sqrt(variance + floor_m**2),
    )


def residuals(terms: Terms, camera: Camera, s: F64) -> tuple[F64, F64, F64]:
    """Residuals of points (n, 2), lines (m, 2) and planes (p, 1) in standard deviations, at the translation s (3,)."""
    points = (_project(terms.points_m + s, camera) - terms.pixels) / terms.point_sigma_px[:, None]  # eq. 2
    ends = _project(terms.endpoints_m + s, camera)
    lines = (np.einsum("mec,mc->me", ends, terms.lines[:, :2]) + terms.lines[:, 2:]) / terms.line_sigma_px  # eq. 4
    planes = (terms.distances_m - matmul(terms.normals, s) - terms.observed_m) / terms.plane_sigma_m  # eq. 6: n·(p - s) + d = 0
    return points, lines, planes[:, None]


def _project(points_m: F64, camera: Camera) -> F64:
    """Pixels (..., 2) of points (..., 3), those behind the camera as if at `NEAR_M`."""
    z = np.maximum(points_m[..., 2:], NEAR_M)
    return np.asarray(points_m[..., :2] / z * [camera.fx, camera.fy] + [camera.cx, camera.cy], np.float64)
