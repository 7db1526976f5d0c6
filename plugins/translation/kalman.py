"""Position and offsets of planes with the rotation fixed, by a linear Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import eigh, inv, matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Planes, Pose, Rotation, Tracks, Translation
from trihedron.plugins.translation.linear_translation import point_equations, solve_translation


@register("translation", "kalman")
@dataclass(frozen=True)
class Kalman:
    """L-SLAM (Kim, Coltin, Kim, ECCV 2018; the paper's column "L-SLAM"): with the rotation known, the position and one offset for each plane that
    stands on a Manhattan axis are linear in the measurements. Tracked points with and without depth predict the translation (as `irls`), the
    distances to the planes along their axes correct it, and a new plane is appended to the state.

    The state is `filtered_planes` and `filtered_covariance` of the value, so that the wire `translation@prev` is the filter's only memory."""

    axis_deg: Annotated[float, Range(above=0, below=45)] = 8.0  # a plane nearer to an axis stands on it
    distance_sigma_m: PositiveFloat = 0.01  # of a plane's distance, besides its noise: walls are not quite flat, and normals not quite on the axis
    point_sigma_m: PositiveFloat = 0.002  # of a translation measured by points, besides its noise
    gate: PositiveFloat = 3.0  # standard deviations, and
    gate_m: PositiveFloat = 0.1  # most, between a plane's distance and the predicted one
    min_pixels: PositiveInt = 3000  # of a plane in the state
    motion_sigma_m: PositiveFloat = 0.1  # of a translation that no point measured, per frame
    min_points: Annotated[int, Range(3)] = 6

    def __call__(
        self,
        camera: Camera,
        rotation: Rotation,
        tracks: Tracks | None,
        keypoints: Keypoints,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_pose: Pose | None,
        previous: Translation | None,
    ) -> Translation:
        """Return the filtered position; the first frame's is the origin of the world."""
        observations = observe_axis_planes(planes, rotation, self.axis_deg, self.distance_sigma_m, self.min_pixels)
        if previous is None or previous_pose is None:
            state, matched = initial_filter().update(observations, self.gate, self.gate_m)
            return self._value(rotation, state, np.empty((0, 3)), (0, 0, matched), True)
        before = OffsetFilter.of(previous)
        step, noise, points = self._translation(camera, rotation, tracks, keypoints, previous_keypoints, previous_pose)
        state, matched = before.predict(step, noise).update(observations, self.gate, self.gate_m)
        unobservable = _unobserved_directions(noise, observations[:matched], 0.5 * self.motion_sigma_m)
        return self._value(rotation, state, unobservable, (points, 0, matched), points + matched > 0)

    def _translation(
        self, camera: Camera, rotation: Rotation, tracks: Tracks | None, keypoints: Keypoints, before: Keypoints | None, pose: Pose
    ) -> tuple[F64, F64, int]:
        """Translation by the points (3,) with covariance (3, 3), both in the world, and the number of inliers."""
        R, gap = rotation.R_world_camera, max(rotation.index - pose.index, 1)
        if tracks is not None and before is not None and tracks.previous_index == pose.index == before.index:
            equations = point_equations(tracks, keypoints, before, camera, matmul(R.T, pose.T_world_camera[:3, :3]), rotation.covariance, True)
            found = solve_translation(equations, np.zeros(3), self.motion_sigma_m * gap)
            if found.inliers >= self.min_points:
                return matmul(-R, found.s), matmul(R, found.covariance, R.T) + self.point_sigma_m**2 * np.eye(3), found.inliers
        return np.zeros(3), (self.motion_sigma_m * gap) ** 2 * np.eye(3), 0

    def _value(self, rotation: Rotation, state: OffsetFilter, unobservable: F64, inliers: tuple[int, int, int], estimated: bool) -> Translation:
        covariance = np.ascontiguousarray(state.covariance[:3, :3])
        counts = np.array(inliers, np.int32)
        return Translation(
            rotation.index, rotation.stamp_ns, state.position_m, covariance, unobservable, counts, estimated, state.planes, state.covariance
        )  # fmt: skip


def _unobserved_directions(noise: F64, matched: list[AxisPlane], limit_m: float) -> F64:
    """Unit vectors (u, 3) (world) along which neither the points nor a known plane measured the position to `limit_m`."""
    information = inv(noise) + sum((np.outer(s.normal, s.normal) / s.variance for s in matched), np.zeros((3, 3)))
    values, vectors = eigh(information)
    return np.ascontiguousarray(vectors[:, values < 1.0 / limit_m**2].T)


# A linear Kalman filter over the camera's position and the offsets of planes whose normals are known (Kim, Coltin, Kim, ECCV 2018).

SAME_AXIS = 0.99  # cosine between the normals of one plane, seen twice
SLACK_M = 0.01  # added to the gate: planes this near are one
FIRST_SIGMA_M = 1e-6  # the first position is the origin by definition


@dataclass(frozen=True)
class AxisPlane:
    """Observation of a plane on a signed Manhattan axis `normal` (3,) of the world: its distance from the camera along it (m), and the variance
    (m²)."""

    normal: F64
    distance_m: float
    variance: float


@dataclass(frozen=True)
class OffsetFilter:
    """`position_m` (3,), `planes` (m, 4) as (n, d) of the world, and the covariance (3 + m, 3 + m) of the position and all d."""

    position_m: F64
    planes: F64
    covariance: F64

    @classmethod
    def of(cls, translation: Translation) -> OffsetFilter:
        """Return the filter that a translation holds; one of another plugin holds none, and a filter without planes begins there."""
        if not len(translation.filtered_covariance):
            return cls(translation.t_world_camera, np.empty((0, 4)), translation.covariance)
        return cls(translation.t_world_camera, translation.filtered_planes, translation.filtered_covariance)

    def predict(self, step: F64, noise: F64) -> OffsetFilter:
        """Predict: move the camera by a translation (3,) with process noise (3, 3)."""
        covariance = self.covariance.copy()
        covariance[:3, :3] += noise
        return OffsetFilter(self.position_m + step, self.planes, covariance)

    def update(self, observations: list[AxisPlane], gate: float, gate_m: float) -> tuple[OffsetFilter, int]:
        """Update by the observations of known planes (`distance = n·position + d`), append the others; also the number of the former.

        Sorts the observations in that order."""
        state, fresh, known = self, [], []
        for observation in observations:
            row = self._row(observation, gate, gate_m)
            if row < 0:
                fresh.append(observation)
            else:
                known.append(observation)
                state = state._correct(observation, row)
        for observation in fresh:
            state = state._append(observation)
        observations[:] = known + fresh
        return state, len(known)

    def _row(self, observation: AxisPlane, gate: float, gate_m: float) -> int:
        """Row of the known plane nearest to an observation within the gates, -1 = none."""
        n, P = observation.normal, self.covariance
        off = np.abs(observation.distance_m - matmul(n, self.position_m) - self.planes[:, 3])
        variance = matmul(n, P[:3, :3], n) + matmul(2.0 * n, P[:3, 3:]) + np.diag(P)[3:] + observation.variance
        within = (matmul(self.planes[:, :3], n) > SAME_AXIS) & (off < np.minimum(gate * np.sqrt(variance) + SLACK_M, gate_m))
        return int(np.argmin(np.where(within, off, np.inf))) if within.any() else -1

    def _measurement_row(self, normal: F64, row: int) -> F64:
        h = np.zeros(3 + len(self.planes))
        h[:3], h[3 + row] = normal, 1.0
        return h

    def _correct(self, observation: AxisPlane, row: int) -> OffsetFilter:
        h, P = self._measurement_row(observation.normal, row), self.covariance
        gain = matmul(P, h) / (matmul(h, P, h) + observation.variance)
        change = gain * (observation.distance_m - matmul(observation.normal, self.position_m) - self.planes[row, 3])
        rest = np.eye(len(h)) - np.outer(gain, h)
        planes = self.planes.copy()
        planes[:, 3] += change[3:]
        return OffsetFilter(self.position_m + change[:3], planes, matmul(rest, P, rest.T) + observation.variance * np.outer(gain, gain))

    def _append(self, observation: AxisPlane) -> OffsetFilter:
        n, P = observation.normal, self.covariance
        m = len(P)
        covariance = np.zeros((m + 1, m + 1))
        covariance[:m, :m] = P
        covariance[m, :m] = covariance[:m, m] = matmul(-n, P[:3])
        covariance[m, m] = matmul(n, P[:3, :3], n) + observation.variance
        plane = np.append(n, observation.distance_m - matmul(n, self.position_m))
        return OffsetFilter(self.position_m, np.concatenate([self.planes, plane[None]]), covariance)


def initial_filter() -> OffsetFilter:
    """At the origin, without planes."""
    return OffsetFilter(np.zeros(3), np.empty((0, 4)), FIRST_SIGMA_M**2 * np.eye(3))


def observe_axis_planes(planes: Planes, rotation: Rotation, axis_deg: float, floor_m: float, min_pixels: int) -> list[AxisPlane]:
    """Observations of the planes on an axis of the most observed Manhattan frame in view, by the distance of their centroid along it."""
    seen = np.isfinite(rotation.R_camera_manhattan[:, 0, 0])
    if not seen.any():
        return []
    axes = rotation.R_world_manhattan[int(np.argmax(np.where(seen, rotation.weights, -1.0)))]
    along = matmul(planes.coefficients[:, :3], matmul(axes.T, rotation.R_world_camera).T)
    nearest = np.argmax(np.abs(along), axis=1)
    cosines = along[np.arange(len(along)), nearest]
    normals = axes.T[nearest] * np.sign(cosines)[:, None]
    local = matmul(normals, rotation.R_world_camera)
    information = planes.moments[:, 3, 3]
    centres = planes.moments[:, :3, 3] / information[:, None]
    distances = (centres * local).sum(axis=1)
    aside2 = (centres * centres).sum(axis=1) - distances**2
    variances = 1.0 / information + float(np.trace(rotation.covariance)) / 3.0 * aside2 + floor_m**2
    stand = (np.abs(cosines) >= np.cos(np.radians(axis_deg))) & (planes.pixels >= min_pixels)
    return [AxisPlane(normals[row], -float(distances[row]), float(variances[row])) for row in np.flatnonzero(stand)]
