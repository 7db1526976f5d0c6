"""The turn of a map out of its Manhattan frame that errors of the camera's calibration explain.

A focal length that is wrong by 0.4 % turns a camera that looks round once by 1.4° too far or too little, and the map with it, while every frame
agrees with the landmarks near it. How each keyframe errs by the calibration is known (`sensitivity`), and directions repeat all through a building:
where they turn from keyframe to keyframe as a wrong calibration would turn them, it is what moved the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.lie import adjoint_between
from trihedron.pipeline.core.linalg import inv, matmul, solve
from trihedron.pipeline.core.types import CALIBRATION, F64, I32

LEAST_F = 10.0  # of Fisher's test; at most 9.5 of 2400 maps whose directions err at random, together over one to eight keyframes


@dataclass(frozen=True)
class CalibrationErrors:
    """Errors of k keyframes by the calibration, estimated by their directions."""

    xi: F64  # (k, 6) of `T_world_camera · Exp(xi)`, which undoes them
    sensitivity: F64  # (k, 6, 12) of the keyframes once they are undone
    covariance: F64  # (k, 6, 6) of xi, by the noise of the directions


def errors_by_calibration(poses: F64, rotations: F64, information: F64, sensitivity: F64, turns: F64, since: int) -> CalibrationErrors:
    """Estimate the errors that the calibration gave to keyframes at `poses` (k, 4, 4) since the first of them; zeros where their directions do not
    show them. The estimate is linear in the errors, and so are those that it leaves.

    `rotations` (k, 3) agree best with the axes, with `information` (k, 3, 3) and sensitivity `turns` (k, 3, 12), see `ManhattanPrior`; `sensitivity`
    (k, 6, 12) is that of the poses. Keyframes up to the row `since` may have been corrected before, so that the calibration is estimated separately
    for them and for the later ones: by least squares with its standard deviations as prior (ridge regression), together with one rotation of all
    keyframes, the error of the axes. It counts where it explains more than as many parameters would explain of noise (F-test)."""
    R = poses[:, :3, :3]
    first, before = (_carried(poses, sensitivity, np.minimum(np.arange(len(poses)), row)) for row in (0, since))
    errors = np.concatenate([before - first, sensitivity - before], axis=2)  # (k, 6, 24)
    measured, later = turns - sensitivity[:, 3:], (np.arange(len(poses)) > since)[:, None, None]  # what turns besides the poses
    observed = errors[:, 3:] + np.concatenate([np.where(later, 0.0, measured), np.where(later, measured, 0.0)], axis=2)
    turned, W = matmul(R, rotations[..., None])[..., 0], matmul(R, information, np.swapaxes(R, 1, 2))
    X = np.concatenate([np.broadcast_to(np.eye(3), R.shape), matmul(R, observed)], axis=2)
    rows, weighted, y = X.reshape(-1, X.shape[2]), matmul(W, X).reshape(-1, X.shape[2]), turned.ravel()
    H, b, prior = matmul(rows.T, weighted), matmul(weighted.T, y), np.eye(X.shape[2])  # 1 rad is no constraint on the axes
    x = solve(H + prior, b)
    residuals = (y - matmul(rows, x)).reshape(-1, 3)
    total = (turned * matmul(W, turned[..., None])[..., 0]).sum()
    unexplained = total - matmul(b[:3], solve(H[:3, :3] + np.eye(3), b[:3]))
    rest = total - matmul(b, x)  # with the prior's part
    parameters = np.trace(solve(H + prior, H)) - 3.0
    freedom = 3.0 * _independent(matmul(W, residuals[..., None])[..., 0], residuals) - 3.0 - parameters
    if freedom <= 0.0 or (unexplained - rest) * freedom < LEAST_F * parameters * rest:
        return CalibrationErrors(np.zeros((len(poses), 6)), sensitivity, np.zeros((len(poses), 6, 6)))
    left = np.asarray(inv(H + prior), np.float64)  # share of an error that is left: 1 - (H + prior)⁻¹ H, the prior being 1
    noise, left = matmul(left, H, left)[3:, 3:], left[3:, 3:]
    sensitivity = first + matmul(errors, left[:, :CALIBRATION] + left[:, CALIBRATION:])
    return CalibrationErrors(matmul(errors, x[3:]), sensitivity, matmul(errors, noise, np.swapaxes(errors, 1, 2)))


def _carried(poses: F64, sensitivity: F64, rows: I32) -> F64:
    """Return the sensitivity (k, 6, 12) of a camera that moves rigidly with keyframe `rows[i]` to keyframe i."""
    return np.asarray(matmul(adjoint_between(poses, poses[rows]), sensitivity[rows]))


def _independent(weighted: F64, residuals: F64) -> float:
    """Return the effective number of independent residuals (k, 3) of successive keyframes, `weighted` (k, 3) by their information, from their
    autocorrelation (Bayley and Hammersley, 1946): several keyframes in a row observe the same wall off the axes."""
    squares = (weighted * residuals).sum()
    if not squares > 0.0:
        return 0.0
    correlation = max(float((weighted[1:] * residuals[:-1]).sum() / squares), 0.0)
    return np.count_nonzero(weighted.any(axis=1)) * (1.0 - correlation) / (1.0 + correlation)
