"""The turn of a map out of its Manhattan frame that errors of the camera's calibration explain.

A focal length that is wrong by 0.4 % turns a camera that looks round once by 1.4° too far or too little, and the map with it, while every frame
agrees with the landmarks near it. How each keyframe errs by the calibration is known (`sensitivity`), and directions repeat all through a building:
where they turn from keyframe to keyframe as a wrong calibration would turn them, it is what moved the map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.linalg import eigh, matmul, solve
from trihedron.pipeline.core.types import CALIBRATION, F64
from trihedron.plugins.shared.pose_graph import Edges, parameter_errors

LEAST_F = 4.0  # of Fisher's test; more in 8 of 1200 maps that drift as stated and whose directions err at random, alone or in rows of up to eight
EXCESS = 8.0  # by which the variance of directions is counted: squared errors of estimates are up to 6.6 times what noise explains (five sensors)
REPEATED = 32.0  # the same of what residuals show; with 16, a fifth of the poses of three simulated cameras is outside 95 %


@dataclass(frozen=True)
class CalibrationEstimate:
    """Errors of the calibration, in its units, that have to be undone; zeros where directions show none."""

    parameters: F64  # (12,)
    spread: F64  # (12, 12) root of their covariance, symmetric, so that it is near 1 for what nothing shows


NO_ESTIMATE = CalibrationEstimate(np.zeros(CALIBRATION), np.eye(CALIBRATION))


def estimate_calibration(nodes: F64, edges: Edges, differences: F64, directions: int, information: F64, score: F64) -> CalibrationEstimate:
    """Estimate the calibration together with the drift of the nodes (n, 4, 4) of a pose graph, of whose edges the last (k,) are `directions` of
    keyframes. `differences` (e, 6, 12) are, by the calibration, the errors of the nodes between which an edge is, less that of what it measures.

    The standard deviations of the calibration are its prior (ridge regression). The estimate counts where it explains more than as many parameters
    would explain of noise (F-test), and then together with what residuals show of it, their `information` (12, 12) and `score` (12,)."""
    edges, unit = replace(edges, information=edges.information / EXCESS), np.eye(CALIBRATION)
    y, Y = parameter_errors(nodes, edges, differences)
    weighted = matmul(np.swapaxes(Y, 1, 2), edges.information)
    shown, by_directions = matmul(weighted, Y).sum(axis=0), -matmul(weighted, y[..., None]).sum(axis=0)[:, 0]
    estimate = solve(unit + shown, by_directions)
    explained, parameters = float(matmul(by_directions, estimate)), float(np.trace(solve(unit + shown, shown)))
    rest = np.einsum("ei,eij,ej->", y, edges.information, y) - explained  # with the prior's part
    turned = (y + matmul(Y, estimate))[-directions:, 3:]
    freedom = 3.0 * _independent(matmul(edges.information[-directions:, 3:, 3:], turned[..., None])[..., 0], turned) - 3.0 - parameters
    if freedom <= 0.0 or explained * freedom <= LEAST_F * parameters * rest:
        return NO_ESTIMATE
    known, axes = eigh(unit + shown + information / REPEATED)
    return CalibrationEstimate(matmul(axes, matmul(axes.T, by_directions + score / REPEATED) / known), matmul(axes / np.sqrt(known), axes.T))


def _independent(weighted: F64, residuals: F64) -> float:
    """Return the effective number of independent residuals (k, 3) of successive keyframes, `weighted` (k, 3) by their information, from their
    autocorrelation (Bayley and Hammersley, 1946): several keyframes in a row observe the same wall off the axes."""
    squares = (weighted * residuals).sum()
    if not squares > 0.0:
        return 0.0
    correlation = max(float((weighted[1:] * residuals[:-1]).sum() / squares), 0.0)
    return np.count_nonzero(weighted.any(axis=1)) * (1.0 - correlation) / (1.0 + correlation)
