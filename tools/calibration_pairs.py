"""Calibration from points that pairs of frames observed: focal lengths, errors of depth by range and across the image, and rolling shutters.

A point observed at pixel p with depth z, in a row that was read `s = readout (row - c_y) / h` after the middle one, was at

    X = z' ((p - c) / f, 1),  1 / z' = (1 + radial r²) / z + offset,  and in the middle of the exposure at  X + s (v + ω × X)

in the camera's frame, which moves with angular rate ω and velocity v. The reading was taken later by `delay`, and by its row's part of the readout of
depth instead of s: z is the measured depth less that time times the rate at which the depth at a pixel changes as the camera moves. One factor is
estimated for fx and fy: pixels are squarer than two factors would be known. The motion between the two frames of a pair is estimated with the
parameters, so that an error of the trajectory does not enter. Residuals are pixels and inverse depth in the second frame, robust (Geman and McClure).
The covariance is that of an M-estimator whose terms are blocks of pairs ("sandwich": Huber, 1967), for what a calibration lacks is common to
neighbouring pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.types import F64, Bool, Camera

I64 = NDArray[np.int64]
NAMES = ("log_focal", "depth_offset", "depth_radial", "readout_s", "delay_s", "depth_readout_s")
PRIOR = np.array([0.3, 0.05, 0.1, 0.05, 0.05, 0.05])  # standard deviations
STEP = 1e-4  # of the derivatives
GATE2 = 9.0  # squared Mahalanobis distance, at the scale of the residuals, at which a point counts a quarter
MEDIAN_CHI2 = 2.366  # of three degrees of freedom
ITERATIONS, POSE_ITERATIONS = 10, 4


@dataclass(frozen=True)
class Observations:
    """Points as frames observed them: pixels (n, 2), depths (n,) m, the rates (n,) m/s at which the depth at these pixels changes, the standard
    deviations of pixels and depths, and the motion (n, 6) of the camera (angular rate, velocity) in its own frame."""

    pixels: F64
    depths_m: F64
    depth_rates: F64
    sigma_px: F64
    sigma_m: F64
    motions: F64

    def select(self, rows: NDArray[np.integer] | Bool) -> Observations:
        """Return some rows."""
        return Observations(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence[Observations]) -> Observations:
        """Return the rows of all parts."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


@dataclass(frozen=True)
class Pairs:
    """Pairs of frames: observations of the same points in the first and second frame, (n,) the pair of each, sorted; and per pair an approximate pose
    `T_second_first` (m, 4, 4) and the block (m,)."""

    camera: Camera
    first: Observations
    second: Observations
    pair: I64
    motions: F64
    blocks: I64

    def select(self, chosen: Bool) -> Pairs:
        """Return some of the pairs (m,)."""
        rows = chosen[self.pair]
        number = np.cumsum(chosen) - 1
        return Pairs(
            self.camera, self.first.select(rows), self.second.select(rows), number[self.pair[rows]], self.motions[chosen], self.blocks[chosen]
        )


@dataclass(frozen=True)
class Fit:
    """Parameters (6,) in the order of NAMES, their covariance (6, 6), 0 for those that were held, and the robust cost (m,) of each pair: a mean over
    its points."""

    parameters: F64
    covariance: F64
    costs: F64


def positions(camera: Camera, seen: Observations, parameters: F64) -> F64:
    """(n, 3) points in the middle of the exposure, and in the camera's frame."""
    focal = np.array([camera.fx, camera.fy]) * np.exp(parameters[0])
    apart = seen.pixels - [camera.cx, camera.cy]
    z = 1.0 / _inverse_depths(camera, seen, parameters)
    points = np.concatenate([apart / focal * z[:, None], z[:, None]], axis=1)
    return np.asarray(points + (parameters[3] * _rows(camera, seen))[:, None] * _velocity(seen, points), np.float64)


def _inverse_depths(camera: Camera, seen: Observations, parameters: F64) -> F64:
    """(n,) corrected inverse depths."""
    radius2 = ((seen.pixels - [camera.cx, camera.cy]) ** 2).sum(axis=1) / ((camera.width**2 + camera.height**2) / 4.0)
    later_s = parameters[4] + (parameters[5] - parameters[3]) * _rows(camera, seen)
    z = np.maximum(seen.depths_m - later_s * seen.depth_rates, 0.05)
    return np.asarray(np.maximum((1.0 + parameters[2] * radius2) / z + parameters[1], 1e-3), np.float64)


def _rows(camera: Camera, seen: Observations) -> F64:
    """(n,) the row of each pixel, from -0.5 to 0.5."""
    return np.asarray((seen.pixels[:, 1] - 0.5 * (camera.height - 1)) / camera.height, np.float64)


def _velocity(seen: Observations, points: F64) -> F64:
    """(n, 3) velocity at which points at rest approach the moving camera's origin, with opposite sign."""
    return np.asarray(seen.motions[:, 3:] + np.cross(seen.motions[:, :3], points), np.float64)


def residuals(pairs: Pairs, motions: F64, parameters: F64) -> tuple[F64, F64]:
    """(n, 3) residuals, pixels and inverse depth over their standard deviations, and the (n, 3, 6) Jacobian by the motion's (phi, rho):
    `R <- Exp(phi) R`, `t <- t + rho`."""
    camera, first, second = pairs.camera, pairs.first, pairs.second
    focal = np.array([camera.fx, camera.fy]) * np.exp(parameters[0])
    R, t = motions[pairs.pair, :3, :3], motions[pairs.pair, :3, 3]
    rotated = np.einsum("nij,nj->ni", R, positions(camera, first, parameters))
    middle = rotated + t
    q = middle - (parameters[3] * _rows(camera, second))[:, None] * _velocity(second, middle)
    z = np.maximum(q[:, 2], 0.05)
    apart = second.pixels - [camera.cx, camera.cy]
    measured = _inverse_depths(camera, second, parameters)
    sigma_px = np.hypot(second.sigma_px, first.sigma_px * first.depths_m / second.depths_m)
    sigma_per_m = np.hypot(second.sigma_m / second.depths_m**2, first.sigma_m / first.depths_m**2)
    u = focal * q[:, :2] / z[:, None]
    r = np.column_stack([(u - apart) / sigma_px[:, None], (measured - 1.0 / z) / sigma_per_m])
    D = np.zeros((len(q), 3, 3))
    D[:, 0, 0], D[:, 1, 1] = focal[0] / z / sigma_px, focal[1] / z / sigma_px
    D[:, :2, 2] = -u / z[:, None] / sigma_px[:, None]
    D[:, 2, 2] = 1.0 / z**2 / sigma_per_m
    return r, np.concatenate([np.cross(rotated[:, None], D), D], axis=2)


def scale_of(pairs: Pairs) -> float:
    """Variance of the residuals relative to the stated one, from their median, with the parameters 0."""
    motions = pairs.motions
    for _ in range(2):
        found = fit(pairs, (), 4.0, motions)
        r, _ = residuals(pairs, found[1], np.zeros(len(NAMES)))
        motions = found[1]
    return max(float(np.median((r**2).sum(axis=1))) / MEDIAN_CHI2, 0.1)


def fit(pairs: Pairs, free: Sequence[int], scale: float, motions: F64 | None = None, held: F64 | None = None) -> tuple[Fit, F64]:
    """Estimate the motions of all pairs and the `free` parameters, the others `held` (0 by default); residuals have the variance `scale`.

    Returns the fit and the motions (m, 4, 4)."""
    chosen, count = list(free), len(pairs.motions)
    T = np.array(pairs.motions if motions is None else motions)
    parameters = np.zeros(len(NAMES)) if held is None else held.copy()
    covariance = np.zeros((len(NAMES), len(NAMES)))
    for _ in range(ITERATIONS if chosen else POSE_ITERATIONS):
        r, J = residuals(pairs, T, parameters)
        K = _shared_jacobian(pairs, T, parameters, chosen)
        weights = (GATE2 / (GATE2 + (r**2).sum(axis=1) / scale)) ** 2
        A = _sums(pairs.pair, count, np.einsum("nij,n,nik->njk", J, weights, J)) + 1e-6 * np.eye(6)
        g = _sums(pairs.pair, count, np.einsum("nij,n,ni->nj", J, weights, r))
        B = _sums(pairs.pair, count, np.einsum("nij,n,nik->njk", J, weights, K))
        step = np.zeros(0)
        if chosen:
            C = _sums(pairs.pair, count, np.einsum("nij,n,nik->njk", K, weights, K))
            h = _sums(pairs.pair, count, np.einsum("nij,n,ni->nj", K, weights, r))
            AB, Ag = np.linalg.solve(A, B), np.linalg.solve(A, g[..., None])[..., 0]
            reduced = C - np.einsum("mji,mjk->mik", B, AB)
            score = h - np.einsum("mji,mj->mi", B, Ag)
            prior = np.diag(scale / PRIOR[chosen] ** 2)
            H = reduced.sum(axis=0) + prior
            step = -np.linalg.solve(H, score.sum(axis=0) + prior @ parameters[chosen])
            parameters[chosen] += step
            covariance[np.ix_(chosen, chosen)] = _sandwich(H, score, pairs.blocks)
        moved: F64 = np.asarray(-np.linalg.solve(A, (g + (B @ step if chosen else 0.0))[..., None])[..., 0], np.float64)
        for k in range(count):
            T[k, :3, :3] = exp_so3(moved[k, :3]) @ T[k, :3, :3]
        T[:, :3, 3] += moved[:, 3:]
    r, _ = residuals(pairs, T, parameters)
    squared = (r**2).sum(axis=1) / scale
    costs = np.bincount(pairs.pair, GATE2 * squared / (GATE2 + squared), count) / np.maximum(np.bincount(pairs.pair, minlength=count), 1)
    return Fit(parameters, covariance, costs), T


def _shared_jacobian(pairs: Pairs, T: F64, parameters: F64, chosen: list[int]) -> F64:
    """(n, 3, k) derivatives of the residuals by the chosen parameters, by central differences."""
    K = np.zeros((len(pairs.pair), 3, len(chosen)))
    for column, k in enumerate(chosen):
        step = np.zeros(len(NAMES))
        step[k] = STEP
        K[:, :, column] = (residuals(pairs, T, parameters + step)[0] - residuals(pairs, T, parameters - step)[0]) / (2.0 * STEP)
    return K


def _sums(pair: I64, count: int, values: F64) -> F64:
    """(count, ...) sums of the values (n, ...) of each pair; `pair` is sorted."""
    flat = values.reshape(len(values), -1)
    starts = np.searchsorted(pair, np.arange(count))
    return np.asarray(np.add.reduceat(flat, starts, axis=0).reshape(count, *values.shape[1:]), np.float64)


def _sandwich(H: F64, score: F64, blocks: I64) -> F64:
    names = np.unique(blocks)
    of_block = np.array([score[blocks == block].sum(axis=0) for block in names])
    of_block -= of_block.mean(axis=0)
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ (of_block.T @ of_block) @ inverse * len(names) / max(len(names) - 1, 1), np.float64)
