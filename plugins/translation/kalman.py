"""Position and offsets of planes with the rotation fixed, by a linear Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Frame, Keypoints, Planes, Pose, Rotation, Tracks, Translation
from trihedron.plugins.numerics.motion.derotated_points import point_rows, solve_step
from trihedron.plugins.numerics.motion.offset_filter import OffsetFilter, Sight, axis_sights, first_filter


@register("translation", "kalman")
@dataclass(frozen=True)
class Kalman:
    """L-SLAM (Kim, Coltin, Kim, ECCV 2018; the paper's column "L-SLAM"): with the rotation known, the position and one offset for each plane that
    stands on a Manhattan axis are linear in what is measured. Tracked points with and without depth predict the step (as `irls`), the distances to
    the planes along their axes correct it, and a plane that is not known yet joins the state.

    The state is `filtered_planes` and `filtered_covariance` of the value, so that the wire `translation@prev` is the filter's only memory."""

    axis_deg: float = 8.0  # a plane nearer to an axis stands on it
    distance_sigma_m: float = 0.01  # of a plane's distance, besides its noise: walls are not quite flat, and normals not quite on the axis
    point_sigma_m: float = 0.002  # of a step measured by points, besides its noise
    gate: float = 3.0  # standard deviations, and
    gate_m: float = 0.1  # most, between a plane's distance and the predicted one
    min_pixels: int = 3000  # of a plane in the state
    motion_sigma_m: float = 0.1  # of a step that no point measured, per frame
    min_points: int = 6

    def __post_init__(self) -> None:
        if not 0.0 < self.axis_deg < 45.0 or self.min_points < 3 or self.min_pixels < 1:
            raise ValueError("axis_deg, min_points, min_pixels: an angle within 0 … 45, at least 3, at least 1")
        if min(self.distance_sigma_m, self.point_sigma_m, self.gate, self.gate_m, self.motion_sigma_m) <= 0.0:
            raise ValueError("distance_sigma_m, point_sigma_m, gate, gate_m, motion_sigma_m: must be positive")

    def __call__(
        self,
        frame: Frame,
        rotation: Rotation,
        tracks: Tracks | None,
        keypoints: Keypoints,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_pose: Pose | None,
        previous: Translation | None,
    ) -> Translation:
        """The filtered position; the first frame's is the origin of the world."""
        sights = axis_sights(planes, rotation, self.axis_deg, self.distance_sigma_m, self.min_pixels)
        if previous is None or previous_pose is None:
            state, matched = first_filter().updated(sights, self.gate, self.gate_m)
            return self._said(frame, state, np.empty((0, 3)), (0, 0, matched), True)
        before = OffsetFilter(previous.t_world_camera, previous.filtered_planes, previous.filtered_covariance)
        step, noise, points = self._step(frame, rotation, tracks, keypoints, previous_keypoints, previous_pose)
        state, matched = before.moved(step, noise).updated(sights, self.gate, self.gate_m)
        unobservable = _unmeasured(noise, sights[:matched], 0.5 * self.motion_sigma_m)
        return self._said(frame, state, unobservable, (points, 0, matched), points + matched > 0)

    def _step(
        self, frame: Frame, rotation: Rotation, tracks: Tracks | None, keypoints: Keypoints, before: Keypoints | None, pose: Pose
    ) -> tuple[F64, F64, int]:
        """The step of the position by the points (3,), its covariance (3, 3), both in the world, and how many points agree."""
        R, gap = rotation.R_world_camera, max(frame.index - pose.index, 1)
        if tracks is not None and before is not None and tracks.previous_index == pose.index == before.index:
            rows = point_rows(tracks, keypoints, before, frame.camera, R.T @ pose.T_world_camera[:3, :3], rotation.covariance, True)
            found = solve_step(rows, np.zeros(3), self.motion_sigma_m * gap)
            if found.inliers >= self.min_points:
                return -R @ found.s, R @ found.covariance @ R.T + self.point_sigma_m**2 * np.eye(3), found.inliers
        return np.zeros(3), (self.motion_sigma_m * gap) ** 2 * np.eye(3), 0

    def _said(self, frame: Frame, state: OffsetFilter, unobservable: F64, inliers: tuple[int, int, int], estimated: bool) -> Translation:
        covariance = np.ascontiguousarray(state.covariance[:3, :3])
        counts = np.array(inliers, np.int32)
        return Translation(
            frame.index, frame.stamp_ns, state.position_m, covariance, unobservable, counts, estimated, state.planes, state.covariance
        )  # fmt: skip


def _unmeasured(noise: F64, matched: list[Sight], limit_m: float) -> F64:
    """(u, 3) unit vectors (world) along which neither the points' step nor a known plane measured the position to `limit_m`."""
    information = np.linalg.inv(noise) + sum((np.outer(s.normal, s.normal) / s.variance for s in matched), np.zeros((3, 3)))
    values, vectors = np.linalg.eigh(information)
    return np.ascontiguousarray(vectors[:, values < 1.0 / limit_m**2].T)
