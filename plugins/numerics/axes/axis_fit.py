"""From a frame's features to directions on the sphere, and from directions on three axes to a rotation with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.types import F32, F64, I32, Bool, Planes, Segments
from trihedron.plugins.numerics.axes.direction_information import isotropic_information, line_directions, plane_information
from trihedron.plugins.numerics.axes.manhattan_modes import NORMALS_PER_SAMPLE, Directions
from trihedron.plugins.numerics.axes.sphere_modes import assign_axes, fit_rotation, subsample_normals

NOTHING_KNOWN = np.radians(30.0) ** 2  # rad², variance of a rotation that was not measured


def gather_directions(normals: F32 | None, segments: Segments | None, samples: int, line_weight_per_px: float) -> Directions:
    """At most `samples` of a grid of normals (h, w, 3), each of weight 1, and the directions of the 3D lines, weighted by their image length."""
    surface = np.zeros((0, 3)) if normals is None else subsample_normals(normals, samples)
    if segments is None:
        return Directions(surface, np.ones(len(surface)), len(surface))
    along = (segments.endpoints_m[:, 1] - segments.endpoints_m[:, 0]).astype(np.float64)
    length = np.linalg.norm(along, axis=1)
    pixels = np.linalg.norm(segments.endpoints_px[:, 1] - segments.endpoints_px[:, 0], axis=1)
    good = (length > 1e-6) & np.isfinite(length) & np.isfinite(pixels)
    vectors = np.concatenate([surface, along[good] / length[good, None]])
    return Directions(vectors, np.concatenate([np.ones(len(surface)), line_weight_per_px * pixels[good]]), len(surface))


@dataclass(frozen=True)
class AxisFit:
    """Fits a rotation to the planes and lines near its axes by their covariances, the mean of the normals on an axis counting like one more plane."""

    cone_deg: float = 12.0  # half-angle about the axes within which planes and lines take part
    normals_floor_deg: float = 0.5  # error of an axis however many normals it has
    plane_floor_deg: float = 0.3  # a wall's deviation from the axis
    line_floor_deg: float = 0.5  # an edge's
    floor_deg: float = 0.1  # of the whole rotation
    gate: float = 2.0  # σ at which a plane or line counts half
    use_planes: bool = True
    use_lines: bool = True

    def __post_init__(self) -> None:
        if min(self.normals_floor_deg, self.plane_floor_deg, self.line_floor_deg, self.floor_deg) <= 0.0:
            raise ValueError("normals_floor_deg, plane_floor_deg, line_floor_deg, floor_deg: must be positive")
        if self.gate <= 0.0:
            raise ValueError("gate: must be positive")

    def __call__(self, R: F64, axes: F64, normals: F64, taking_part: Bool, segments: Segments, planes: Planes) -> tuple[F64, F64]:
        """The rotation fitted from R (3, 3), and the covariance of phi (3, 3).

        `axes` (3, 3) are the means of the normals on each axis, `normals` (3, 4) their statistics about these (`mode_statistics`); only the axes
        `taking_part` (3,) are fitted."""
        measured, information, on_axis = self.measured(R, axes, normals, segments, planes)
        on_axis[(on_axis >= 0) & ~taking_part[on_axis]] = -1
        R, H, chi2, components = fit_rotation(measured, information, on_axis, R, self.gate, 5)
        scale = max(chi2 / max(components - 3.0, 1.0), 1.0)
        return R, np.linalg.inv(H / scale + np.eye(3) / NOTHING_KNOWN) + np.eye(3) * np.radians(self.floor_deg) ** 2

    def measured(self, R: F64, axes: F64, normals: F64, segments: Segments, planes: Planes) -> tuple[F64, F64, I32]:
        """Directions (n, 3) of planes, lines and the means of the normals, their information (n, 3, 3) and the column of R (3, m) that each
        belongs to (-1: none). `axes` (3, m) and `normals` (m, 4) as above."""
        lines, line_weight, _ = line_directions(segments.endpoints_m, segments.covariance_m2, np.radians(self.line_floor_deg))
        plane_weight = plane_information(planes.coefficients, planes.covariance, np.radians(self.plane_floor_deg))
        independent = np.maximum(normals[:, 0] / NORMALS_PER_SAMPLE, 1.0)
        sigma = np.sqrt(normals[:, 2] / (2.0 * independent) + np.radians(self.normals_floor_deg) ** 2)
        measured = np.concatenate([planes.coefficients[:, :3], lines, axes.T])
        information = np.concatenate([plane_weight, line_weight, isotropic_information(axes.T, sigma)])
        on_axis = assign_axes(measured, R, np.radians(self.cone_deg))
        used = [self.use_planes] * len(plane_weight) + [self.use_lines] * len(lines) + list(normals[:, 0] > 0)
        on_axis[~(np.array(used) & np.isfinite(measured).all(axis=1))] = -1
        return measured, information, on_axis


def _half_sphere(count: int) -> F64:
    k = np.arange(count) + 0.5
    z, turn = 1.0 - k / count, k * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    directions.flags.writeable = False
    return directions


HALF_SPHERE = _half_sphere(256)  # (256, 3) directions about 9° apart over half the sphere (Fibonacci)
