"""From a frame's features to directions on the sphere, and from directions on three axes to a rotation with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, Bool, Planes, Segments
from trihedron.plugins.numerics.algebra.small_linear import inverse_positive
from trihedron.plugins.numerics.axes.direction_information import measured_directions
from trihedron.plugins.numerics.axes.manhattan_modes import Directions
from trihedron.plugins.numerics.axes.mode_tests import NORMALS_PER_SAMPLE
from trihedron.plugins.numerics.axes.sphere_modes import assign_axes, fit_rotation, subsample_normals

NOTHING_KNOWN = np.radians(30.0) ** 2  # rad², variance of a rotation that was not measured
BEFOREHAND = 3.0
NO_NORMALS, NO_LINES_M, NO_LINES_PX = (np.zeros(shape, np.float32) for shape in ((0, 0, 3), (0, 2, 3), (0, 2, 2)))


def gather_directions(normals: F32 | None, segments: Segments | None, samples: int, line_weight_per_px: float) -> Directions:
    """At most `samples` of a grid of normals (h, w, 3), each of weight 1, and the directions of the 3D lines, weighted by their image length."""
    grid = NO_NORMALS if normals is None else normals
    ends_m, ends_px = (NO_LINES_M, NO_LINES_PX) if segments is None else (segments.endpoints_m, segments.endpoints_px)
    return Directions(*_gathered(grid, ends_m, ends_px, samples, line_weight_per_px))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gathered(normals: F32, ends_m: F32, ends_px: F32, samples: int, per_px: float) -> tuple[F64, F64, int]:
    """The fields of `Directions`."""
    surface = subsample_normals(normals, samples)
    count = len(surface)
    vectors, weights = np.empty((count + len(ends_m), 3)), np.ones(count + len(ends_m))
    vectors[:count] = surface
    n = count
    for i in range(len(ends_m)):
        square, pixels = 0.0, 0.0
        for k in range(3):
            vectors[n, k] = float(ends_m[i, 1, k]) - ends_m[i, 0, k]
            square += vectors[n, k] ** 2
        for k in range(2):
            pixels += (float(ends_px[i, 1, k]) - ends_px[i, 0, k]) ** 2
        if 1e-12 < square < np.inf and np.isfinite(pixels):
            for k in range(3):
                vectors[n, k] /= np.sqrt(square)
            weights[n] = per_px * np.sqrt(pixels)
            n += 1
    return vectors[:n], weights[:n], count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def variance_scale(chi2: float, freedom: float) -> float:
    """Of the variances assumed, by the residuals' χ² with so many degrees of freedom. The assumption counts like BEFOREHAND more: a scene that shows
    little keeps it, one with many planes and edges tells by itself how true its walls are."""
    return (chi2 + BEFOREHAND) / (max(freedom, 0.0) + BEFOREHAND)


@dataclass(frozen=True)
class AxisFit:
    """Fits a rotation to the planes and lines near its axes by their covariances, the mean of the normals on an axis counting like one more plane."""

    cone_deg: float = 12.0  # half-angle about the axes within which planes and lines take part
    normals_floor_deg: float = 0.5  # error of an axis however many normals it has
    plane_floor_deg: float = 0.3  # a wall's deviation from the axis
    line_floor_deg: float = 0.5  # an edge's
    floor_deg: float = 0.05  # of the whole rotation
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
        features = planes.coefficients, planes.covariance, segments.endpoints_m, segments.covariance_m2
        return _fitted(R, axes, normals, taking_part, *features, self._rules, self.gate, float(np.radians(self.floor_deg)))  # type: ignore[no-any-return]

    def measured(self, R: F64, axes: F64, normals: F64, segments: Segments, planes: Planes) -> tuple[F64, F64, I32]:
        """Directions (n, 3) of planes, lines and the means of the normals, their information (n, 3, 3) and the column of R (3, m) that each
        belongs to (-1: none). `axes` (3, m) and `normals` (m, 4) as above."""
        features = planes.coefficients, planes.covariance, segments.endpoints_m, segments.covariance_m2
        return _measured(R, axes, normals, *features, self._rules)  # type: ignore[no-any-return]

    @cached_property
    def _rules(self) -> Rules:
        angles = self.cone_deg, self.normals_floor_deg, self.plane_floor_deg, self.line_floor_deg
        cone, normals, planes, lines = (float(np.radians(angle)) for angle in angles)
        return Rules(cone, normals, planes, lines, self.use_planes, self.use_lines)


class Rules(NamedTuple):
    """Of `AxisFit`, for the kernels; angles in rad."""

    cone: float
    normals_floor: float
    plane_floor: float
    line_floor: float
    use_planes: bool
    use_lines: bool


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fitted(
    R: F64, axes: F64, normals: F64, taking_part: Bool, planes: F64, plane_covariance: F64, ends_m: F32, end_covariance: F32,
    rules: Rules, gate: float, floor: float,
) -> tuple[F64, F64]:  # fmt: skip
    """`AxisFit` as a kernel."""
    measured, information, on_axis = _measured(R, axes, normals, planes, plane_covariance, ends_m, end_covariance, rules)
    for i in range(len(on_axis)):
        if on_axis[i] >= 0 and not taking_part[on_axis[i]]:
            on_axis[i] = -1
    R, H, chi2, components = fit_rotation(measured, information, on_axis, len(measured) - 3, R, gate, 5)
    scale = variance_scale(chi2, components - 3.0)
    for i in range(3):
        for j in range(3):
            H[i, j] = H[i, j] / scale + (1.0 / NOTHING_KNOWN if i == j else 0.0)
    covariance = inverse_positive(H)
    for i in range(3):
        covariance[i, i] += floor * floor
    return R, covariance


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _measured(
    R: F64, axes: F64, normals: F64, planes: F64, plane_covariance: F64, ends_m: F32, end_covariance: F32, rules: Rules
) -> tuple[F64, F64, I32]:
    """`AxisFit.measured` as a kernel."""
    p, lines, m = len(planes), len(ends_m), len(normals)
    means, sigma = np.empty((m, 3)), np.empty(m)
    for k in range(m):
        independent = max(normals[k, 0] / NORMALS_PER_SAMPLE, 1.0)
        sigma[k] = np.sqrt(normals[k, 2] / (2.0 * independent) + rules.normals_floor**2)
        for a in range(3):
            means[k, a] = axes[a, k]
    measured, information = measured_directions(planes, plane_covariance, rules.plane_floor, ends_m, end_covariance, rules.line_floor, means, sigma)
    on_axis = assign_axes(measured, R, rules.cone)
    for i in range(len(on_axis)):
        used = rules.use_planes if i < p else rules.use_lines if i < p + lines else normals[i - p - lines, 0] > 0.0
        if not used:
            on_axis[i] = -1
    return measured, information, on_axis


def _half_sphere(count: int) -> F64:
    k = np.arange(count) + 0.5
    z, turn = 1.0 - k / count, k * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    directions.flags.writeable = False
    return directions


HALF_SPHERE = _half_sphere(256)  # (256, 3) directions about 9° apart over half the sphere (Fibonacci)
