"""Compare the status of poses with their errors: wrong `ok`, and how well the stated σ predicts the error.

Poses count as they were estimated at the time. Each sub-map has a world of its own and is aligned with the truth by itself, robustly, over its `ok`
frames, since the others claim nothing, or over all posed ones where it has fewer than LEAST_OK of these; smaller sub-maps are left out. An `ok`
frame is wrong where it is off by more than WRONG_M and SIGMAS standard deviations, or by more than WRONG_DEG and SIGMAS; the first pose, which
defines the world, is never. It must be so after the alignment that the covariances make most likely, too: σ is that of a pose in the world of the
first camera, and an alignment over all poses puts half of a drift to where it began. Positions are in the camera frame.

Sharpness is compared with the error by the spread–skill ratio (Fortin et al., Journal of Hydrometeorology 2014): the root of the mean stated variance
of the position over the root mean square of its error, after the alignment that the covariances make most likely, as NEES. 1 is honest, more is too
cautious, less overconfident.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert, umeyama
from trihedron.pipeline.core.linalg import cholesky, matmul
from trihedron.pipeline.core.types import DEGRADED, F64, LOST, OK, Bool, Pose, Trajectory
from trihedron.pipeline.run.consistency import LIMIT_95, TruthNoise, gauge_free_errors, normalised_squares, truth_noise
from trihedron.pipeline.run.metrics import associate, relative_errors, rotation_angles_deg
from trihedron.pipeline.run.stated_sigma import stated_sigma

WRONG_M, WRONG_DEG, SIGMAS = 0.05, 2.0, 4.0
LEAST_POSES = 10  # of a sub-map that is judged
LEAST_OK = 3  # poses with status ok, by which a sub-map is aligned
INLIER = 3.0  # times the median error
ROUNDS = 5
STEP_M = 0.05
FIGURES = re.compile(r"\d+(?:\.\d+)?")  # in a reason
CLAUSE_ENDS = re.compile(r"[:;,]")
TINY = 1e-12  # variance, m² and rad²
EXACT = 1e-10  # total variance below which a pose is exact by definition, as the first: it has no NEES


@dataclass(frozen=True)
class FrameErrors:
    """Errors (n,) of the posed frames with truth: metres, degrees, the largest stated standard deviations, NEES (6 degrees of freedom), and the
    logarithm of the likelihood of the error (nats). `likely_m` is the error of the position after the alignment that the covariances make most
    likely, `likely_deg` that of the rotation, `spread_m` the root of the position's stated variance, along all axes. The latter five are NaN of a
    pose that is exact by definition. `ok` is the status; `judged` is False in sub-maps that are too small, whose errors are NaN; `exact` is True of
    poses that are exact by definition."""

    indices: F64
    judged: Bool
    ok: Bool
    exact: Bool
    error_m: F64
    error_deg: F64
    sigma_m: F64
    sigma_deg: F64
    nees: F64
    log_likelihood: F64
    likely_m: F64
    likely_deg: F64
    spread_m: F64

    @property
    def wrong_ok(self) -> Bool:
        """Return (n,) whether an `ok` frame is off by more than it states, after either alignment."""
        far = np.minimum(self.error_m, self.likely_m) > np.maximum(WRONG_M, SIGMAS * self.sigma_m)
        turned = np.minimum(self.error_deg, self.likely_deg) > np.maximum(WRONG_DEG, SIGMAS * self.sigma_deg)
        return np.asarray(self.ok & self.judged & ~self.exact & (far | turned))


@dataclass(frozen=True)
class StatusCheck:
    """Figures of a run; None where too few frames are posed. Honest covariances have `nees_median` 5.35 and `share_within_95` 0.95. `sigma_auc` is
    the probability that of two frames, one above the median error and one below, the former has the larger σ: 0.5 is that of a σ by chance. Like
    NEES it takes errors after the alignment that the covariances make most likely: σ is that of a pose in the world of the first camera, and grows
    with the way from there, where the alignment of the ATE spreads a drift evenly. `spread_over_error` is the spread–skill ratio. `not_ok` counts
    the frames that are not ok by the test that found them so. `sigma_m` is the median σ of the positions of ok poses, which needs no truth."""

    frames: int
    ok: int
    degraded: int
    lost: int
    ate_m: float | None
    wrong_ok: int
    nees_median: float | None
    share_within_95: float | None
    sigma_auc: float | None
    log_likelihood: float | None
    steps_within_50mm: float | None
    steps: int
    spread_over_error: float | None
    not_ok: dict[str, int]
    sigma_m: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)


def check_status(poses: Sequence[Pose], truth: Trajectory, frames: int | None = None) -> tuple[StatusCheck, FrameErrors]:
    """Compare the poses of a run with the truth; `frames` is the number of all frames (default: as many as there are poses)."""
    errors, known, true = _frame_errors(poses, truth)
    steps, close = _steps(known, true)
    e = errors.error_m[errors.judged]
    nees, likelihood = (values[np.isfinite(values)] for values in (errors.nees, errors.log_likelihood))
    status = [pose.status for pose in poses]
    found, likely = len(e) > 0, np.isfinite(errors.likely_m)
    figures = StatusCheck(
        frames=frames if frames is not None else len(poses),
        ok=status.count(OK),
        degraded=status.count(DEGRADED),
        lost=status.count(LOST),
        ate_m=float(np.sqrt(np.mean(e**2))) if found else None,
        wrong_ok=int(errors.wrong_ok.sum()),
        nees_median=float(np.median(nees)) if len(nees) else None,
        share_within_95=float((nees <= LIMIT_95).mean()) if len(nees) else None,
        sigma_auc=sigma_auc(errors.likely_m[likely], errors.spread_m[likely]),
        log_likelihood=float(likelihood.mean()) if len(likelihood) else None,
        steps_within_50mm=close / steps if steps else None,
        steps=steps,
        spread_over_error=_spread_over_error(errors),
        sigma_m=stated.median_m if (stated := stated_sigma(poses, [])) is not None else None,
        not_ok=dict(Counter(name_of_test(pose.reason) for pose in poses if pose.status != OK).most_common()),
    )
    return figures, errors


def name_of_test(reason: str) -> str:
    """Return what stays the same of the reason of a status, its first clause without figures: "only … of … matches with the map agree"."""
    return without_figures(CLAUSE_ENDS.split(reason)[0]) or "no reason"


def without_figures(reason: str) -> str:
    """Return a reason with an ellipsis in the place of each number: reasons that differ in numbers alone are one."""
    return FIGURES.sub("…", reason)


def _spread_over_error(errors: FrameErrors) -> float | None:
    """Return the spread–skill ratio; None where no pose has an error."""
    known = np.isfinite(errors.likely_m)
    squared = float(np.mean(errors.likely_m[known] ** 2)) if known.any() else 0.0
    return float(np.sqrt(np.mean(errors.spread_m[known] ** 2) / squared)) if squared > 0.0 else None


def sigma_auc(error_m: F64, sigma_m: F64) -> float | None:
    """Return the area under the ROC curve of "the error is above its median" by σ, both (n,); None where all errors or no two are alike."""
    above = error_m > np.median(error_m) if len(error_m) else np.zeros(0, bool)
    positive, negative = sigma_m[above], np.sort(sigma_m[~above])
    if not len(positive) or not len(negative):
        return None
    smaller = np.searchsorted(negative, positive, "left") + np.searchsorted(negative, positive, "right")  # twice; an equal one counts half
    return float(0.5 * smaller.sum() / (len(positive) * len(negative)))


def _frame_errors(poses: Sequence[Pose], truth: Trajectory) -> tuple[FrameErrors, list[Pose], F64]:
    """Return the errors of the posed frames that have truth, these poses, and their (n, 4, 4) truth."""
    posed = [pose for pose in poses if pose.status != LOST]
    pairs = associate(np.array([pose.stamp_ns for pose in posed], np.int64), truth.stamps_ns)
    known, true = [posed[row] for row, _ in pairs], truth.poses[pairs[:, 1]].reshape(-1, 4, 4)
    n = len(known)
    error_m, error_deg, nees, likelihood, likely_m, likely_deg, spread = (np.full(n, np.nan) for _ in range(7))
    judged = np.zeros(n, bool)
    T = np.array([pose.T_world_camera for pose in known]).reshape(-1, 4, 4)
    S = np.array([pose.covariance for pose in known]).reshape(-1, 6, 6) + TINY * np.eye(6)
    submaps, ok = np.array([pose.submap for pose in known], int), np.array([pose.status == OK for pose in known], bool)
    exact = np.trace(S, axis1=1, axis2=2) <= EXACT
    for submap in np.unique(submaps):
        rows = np.flatnonzero(submaps == submap)
        if len(rows) < LEAST_POSES:
            continue
        judged[rows] = True
        aligned = ok[rows] if np.count_nonzero(ok[rows]) >= LEAST_OK else np.ones(len(rows), bool)
        error_m[rows], error_deg[rows] = _robustly_aligned(T[rows], true[rows], aligned)
        rows = rows[~exact[rows]]
        if len(rows) < 2:
            continue
        covariances = S[rows] + _noise_of_truth([known[row] for row in rows], true[rows]).covariance
        nees[rows], likelihood[rows], likely_m[rows], likely_deg[rows] = _normalised_errors(T[rows], covariances, true[rows])
        spread[rows] = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    sigma = np.sqrt(np.diagonal(S, axis1=1, axis2=2))
    indices = np.array([pose.index for pose in known], float)
    sigma_m, sigma_deg = sigma[:, :3].max(axis=1, initial=0.0), np.degrees(sigma[:, 3:].max(axis=1, initial=0.0))
    errors = FrameErrors(indices, judged, ok, exact, error_m, error_deg, sigma_m, sigma_deg, nees, likelihood, likely_m, likely_deg, spread)
    return errors, known, true


def _robustly_aligned(T: F64, true: F64, aligned: Bool) -> tuple[F64, F64]:
    """Return (n,) metres and degrees by which poses (n, 4, 4) are off after alignment of the positions of those `aligned`, without the worst ones."""
    inlier, error = aligned, np.zeros(len(T))
    motion = np.eye(4)
    for _ in range(ROUNDS):
        motion = umeyama(T[inlier, :3, 3], true[inlier, :3, 3])
        error = np.linalg.norm(matmul(motion, T)[:, :3, 3] - true[:, :3, 3], axis=1)
        inlier = aligned & (error <= max(INLIER * float(np.median(error[aligned])), 1e-4))
    angle = rotation_angles_deg(matmul(invert(true), motion, T)[:, :3, :3])
    return error, np.asarray(angle - np.median(angle[inlier]))  # a path without turns leaves the rotation of the alignment uncertain


def _noise_of_truth(poses: Sequence[Pose], true: F64) -> TruthNoise:
    """Estimate errors of the truth that are independent from frame to frame."""
    local = np.array([pose.covariance - pose.map_covariance for pose in poses])
    T, indices = np.array([pose.T_world_camera for pose in poses]), np.array([pose.index for pose in poses], np.int32)
    return truth_noise(T, local, true, indices)


def _normalised_errors(T: F64, covariances: F64, true: F64) -> tuple[F64, F64, F64, F64]:
    """Return (n,) NEES, log-likelihood in nats, metres and degrees of the errors of poses."""
    errors = gauge_free_errors(T, covariances, true)
    nees = normalised_squares(errors, covariances)
    log_determinants = 2.0 * np.log(np.diagonal(cholesky(2.0 * np.pi * covariances), axis1=1, axis2=2)).sum(axis=1)
    metres, degrees = np.linalg.norm(errors[:, :3], axis=1), np.degrees(np.linalg.norm(errors[:, 3:], axis=1))
    return nees, -0.5 * (nees + log_determinants), metres, degrees


def _steps(known: Sequence[Pose], true: F64) -> tuple[int, int]:
    """Return the number of steps between posed frames that follow each other in one sub-map, and of those within STEP_M of the true one."""
    T = np.array([pose.T_world_camera for pose in known]).reshape(-1, 4, 4)
    submaps = np.array([pose.submap for pose in known], int)
    first = np.flatnonzero(submaps[:-1] == submaps[1:])
    if not len(first):
        return 0, 0
    metres, _ = relative_errors(T, true, first, first + 1)
    return len(first), int((metres < STEP_M).sum())
