"""Numba kernels of `axis_fit.py`: weighted fit of a rotation to measured directions."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import inverse_positive, polar_rotation, solve_positive
from trihedron.pipeline.core.types import F32, F64, I32, Bool
from trihedron.plugins.manhattan.directions_kernels import NORMALS_PER_SAMPLE
from trihedron.plugins.shared.lie_kernels import left_multiply_exp
from trihedron.plugins.shared.manhattan_frames_kernels import assign_axes, measured_directions

NOTHING_KNOWN = np.radians(30.0) ** 2  # rad², variance of a rotation that was not measured
BEFOREHAND = 3.0  # degrees of freedom, weight of the assumed variances


class FitRules(NamedTuple):
    """Options of the fit that `axis_fit.fit_rules` converts to rad."""

    cone: float
    normals_floor: float
    plane_floor: float
    line_floor: float
    floor: float
    gate: float
    use_planes: bool
    use_lines: bool


@kernel
def fit_axes_kernel(
    R: F64, axes: F64, normals: F64, taking_part: Bool, planes: F64, plane_covariance: F64, ends_m: F32, end_covariance: F32,
    rules: FitRules,
) -> tuple[F64, F64]:  # fmt: skip
    """Fit the rotation and its covariance; see `axis_fit.fit_axes`."""
    measured, information, on_axis = measure_directions_kernel(R, axes, normals, planes, plane_covariance, ends_m, end_covariance, rules)
    for i in range(len(on_axis)):
        if on_axis[i] >= 0 and not taking_part[on_axis[i]]:
            on_axis[i] = -1
    R, H, chi2, components = fit_rotation(measured, information, on_axis, len(measured) - 3, R, rules.gate, 5)
    scale = variance_scale(chi2, components - 3.0)
    for i in range(3):
        for j in range(3):
            H[i, j] = H[i, j] / scale + (1.0 / NOTHING_KNOWN if i == j else 0.0)
    covariance = inverse_positive(H)
    for i in range(3):
        covariance[i, i] += rules.floor * rules.floor
    return R, covariance


@kernel
def measure_directions_kernel(
    R: F64, axes: F64, normals: F64, planes: F64, plane_covariance: F64, ends_m: F32, end_covariance: F32, rules: FitRules
) -> tuple[F64, F64, I32]:
    """Measure directions, information and axes; see `axis_fit.measure_directions`."""
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


@kernel
def variance_scale(chi2: float, freedom: float) -> float:
    """Scale of the assumed variances by the residuals' χ² with so many degrees of freedom. The assumption counts like BEFOREHAND more: a scene that
    shows little keeps it, one with many planes and edges shows by itself how true its walls are."""
    return (chi2 + BEFOREHAND) / (max(freedom, 0.0) + BEFOREHAND)


@kernel
def fit_rotation(directions: F64, information: F64, axes: I32, counted: int, R: F64, gate: float, iterations: int) -> tuple[F64, F64, float, float]:
    """Fit the rotation whose columns `axes[i]` are nearest to measured directions (n, 3), signs free; rows with axis -1 take no part.

    `information` is (n, 3, 3) in 1/rad², zero along the direction. Gauss–Newton on `R <- Exp(phi) R` with Cauchy weights, one half at `gate` σ.
    Returns R, the information of phi (3, 3), and of the first `counted` rows the weighted χ² and the weighted number of its components."""
    R = R.copy()
    H, g, r, v, phi = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    chi2, components = 0.0, 0.0
    for remaining in range(iterations, -1, -1):
        for j in range(3):
            g[j] = 0.0
            for k in range(3):
                H[j, k] = 0.0
        chi2, components = 0.0, 0.0
        for i in range(len(directions)):
            if axes[i] < 0:
                continue
            a, L = R[:, axes[i]], information[i]
            sign = 1.0 if directions[i, 0] * a[0] + directions[i, 1] * a[1] + directions[i, 2] * a[2] > 0.0 else -1.0
            for k in range(3):
                r[k] = sign * directions[i, k] - a[k]
            for k in range(3):
                v[k] = L[k, 0] * r[0] + L[k, 1] * r[1] + L[k, 2] * r[2]
            m2 = r[0] * v[0] + r[1] * v[1] + r[2] * v[2]
            w = 1.0 / (1.0 + m2 / (gate * gate))
            # d(phi × a)/d phi = -[a]×, so the gradient is a × (Λ r) and the Hessian [a]× Λ [a]×ᵀ
            _add_cross(a, v, w, g)
            for j in range(3):
                ex = (0.0, -a[2], a[1]) if j == 0 else ((a[2], 0.0, -a[0]) if j == 1 else (-a[1], a[0], 0.0))  # e_j × a
                for k in range(3):
                    v[k] = L[k, 0] * ex[0] + L[k, 1] * ex[1] + L[k, 2] * ex[2]
                _add_cross(a, v, w, H[:, j])
            if i < counted:
                chi2 += w * m2
                components += 2.0 * w
        if remaining == 0:
            break
        for k in range(3):
            H[k, k] += 1e-6  # a turn that nothing measures stays
        solve_positive(H, g, phi)
        left_multiply_exp(phi, R)
    return R, H, chi2, components


@kernel
def _add_cross(a: F64, v: F64, w: float, out: F64) -> None:
    """out += w (a × v)."""
    out[0] += w * (a[1] * v[2] - a[2] * v[1])
    out[1] += w * (a[2] * v[0] - a[0] * v[2])
    out[2] += w * (a[0] * v[1] - a[1] * v[0])


@kernel
def orthonormal(axes: F64, weights: F64) -> F64:
    """The rotation nearest to three axes, each counting by its weight: the rotation in `Σ w_k a_k e_kᵀ`. An axis of weight 0
    becomes the cross product of the others; with fewer than two weights the remaining turn is arbitrary."""
    return polar_rotation(axes * weights)
