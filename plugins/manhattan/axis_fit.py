"""Fit of a rotation to the planes and lines near its axes by their covariances; the mean of the normals on an axis counts like one more plane."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool, Planes, Segments
from trihedron.plugins.manhattan.axis_fit_kernels import FitRules, fit_axes_kernel, measure_directions_kernel


class ErrorFloors(Protocol):
    """Options of every plugin that fits a rotation to axes, in degrees."""

    @property
    def plane_floor_deg(self) -> float:
        """A wall's deviation from the axis."""

    @property
    def line_floor_deg(self) -> float:
        """An edge's deviation from the axis."""

    @property
    def floor_deg(self) -> float:
        """Least σ of the whole rotation."""


def fit_rules(
    options: ErrorFloors,
    cone_deg: float,
    normals_floor_deg: float,
    gate: float,
    use_planes: bool = True,
    use_lines: bool = True,
) -> FitRules:
    """Return the rules of a fit to what lies within `cone_deg` of an axis.

    `normals_floor_deg` is the error of an axis however many normals it has; a plane or line counts half at `gate` σ."""
    angles = cone_deg, normals_floor_deg, options.plane_floor_deg, options.line_floor_deg, options.floor_deg
    cone, normals, planes, lines, floor = (float(np.radians(angle)) for angle in angles)
    return FitRules(cone, normals, planes, lines, floor, gate, use_planes, use_lines)


def fit_axes(rules: FitRules, R: F64, axes: F64, normals: F64, taking_part: Bool, segments: Segments, planes: Planes) -> tuple[F64, F64]:
    """Fit a rotation from R (3, 3); return it with the covariance of phi (3, 3).

    `axes` (3, 3) are the means of the normals on each axis, `normals` (3, 4) their statistics about these (`mode_statistics`); only the axes
    `taking_part` (3,) are fitted."""
    features = planes.coefficients, planes.covariance, segments.endpoints_m, segments.covariance_m2
    return fit_axes_kernel(R, axes, normals, taking_part, *features, rules)


def measure_directions(rules: FitRules, R: F64, axes: F64, normals: F64, segments: Segments, planes: Planes) -> tuple[F64, F64, I32]:
    """Return the directions (n, 3) of planes, lines and the means of the normals, their information (n, 3, 3) and the column of R (3, m) that each
    belongs to (-1: none). `axes` (3, m) and `normals` (m, 4) as in `fit_axes`."""
    features = planes.coefficients, planes.covariance, segments.endpoints_m, segments.covariance_m2
    return measure_directions_kernel(R, axes, normals, *features, rules)
