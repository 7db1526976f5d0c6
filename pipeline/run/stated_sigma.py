"""σ of the poses of a run: how large it is stated, which cause has the largest share of it, and what would make it smaller.

σ of a position is the root of the trace of its covariance, the root mean square of an error's length as ATE is; that of a rotation likewise."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.registry import covariance_due_to
from trihedron.pipeline.core.types import DEGRADED, OK, Pose
from trihedron.pipeline.run.consistency import judged_poses

NOISE, DRIFT, CALIBRATED, SCALED = "noise", "drift", "calibration", "depth_scale"
CAUSES = {NOISE: "noise of the measurements", DRIFT: "drift of the map", CALIBRATED: "the calibration", SCALED: "the scale of depth"}
SEE_MORE = "turn slower, or give more light"
MEASURE = "measure a length in the room, and state sigmas.depth_scale in camera.yaml"
STATE_SIGMAS = "state how well the camera is known, as sigmas in camera.yaml"
FEW = 0.5  # of the median number of features of the frames that are ok, below which a frame shows few


@dataclass(frozen=True)
class StatedSigma:
    """σ of the `ok` poses without the first, which is exact by definition.

    `share` is the part, of 1, that each of CAUSES has in the variance of their positions: noise of the measurements, drift of the keyframes, an
    imperfect calibration, the scale of all depths; empty where poses state one covariance alone. `few_features` counts the degraded frames that show
    less than FEW of the usual features of the map."""

    poses: int
    median_m: float
    worst_m: float
    median_deg: float
    worst_deg: float
    share: dict[str, float]
    few_features: int

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)


def stated_sigma(poses: Sequence[Pose], calibration_m2: Sequence[float]) -> StatedSigma | None:
    """Return σ of the poses of a run, whose positions owe the variances `calibration_m2`, one a pose or none, to the calibration; None where none but
    the first is ok."""
    judged = judged_poses(poses)
    ok = [pose for pose in judged if pose.status == OK]
    if not ok:
        return None
    sigma_m = np.sqrt([_variance_m2(pose.covariance) for pose in ok])
    sigma_deg = np.degrees(np.sqrt([np.trace(pose.covariance[3:, 3:]) for pose in ok]))
    usual = float(np.median([pose.inliers.sum() for pose in ok]))
    by_calibration = {pose.index: variance for pose, variance in zip(poses, calibration_m2)}
    return StatedSigma(
        poses=len(ok),
        median_m=float(np.median(sigma_m)),
        worst_m=float(sigma_m.max()),
        median_deg=float(np.median(sigma_deg)),
        worst_deg=float(sigma_deg.max()),
        share=_shares(ok, sum(by_calibration[pose.index] for pose in ok)) if by_calibration else {},
        few_features=sum(pose.status == DEGRADED and bool(pose.inliers.sum() < FEW * usual) for pose in judged),
    )


def calibration_variance_m2(pose: Pose) -> float:
    """Return what the variance of a pose's position owes to the calibration."""
    return _variance_m2(covariance_due_to(CALIBRATED, pose)) if pose.sensitivity.any() or pose.depth_scale_sigma else 0.0


def _variance_m2(covariance: Any) -> float:
    return float(np.trace(covariance[:3, :3]))


def _shares(poses: Sequence[Pose], calibration: float) -> dict[str, float]:
    """Return cause -> share of the summed variance of the positions, of which the calibration and the scale of depth have `calibration` (m²)."""
    whole, of_map = (sum(_variance_m2(getattr(pose, name)) for pose in poses) for name in ("covariance", "map_covariance"))
    scaled = sum(float(np.sum((pose.depth_scale_sigma * pose.T_world_camera[:3, 3]) ** 2)) for pose in poses)
    if not (whole > 0.0 and of_map > 0.0):
        return {}
    parts = {NOISE: whole - of_map, DRIFT: of_map - calibration, CALIBRATED: calibration - scaled, SCALED: scaled}
    return {cause: part / whole for cause, part in parts.items()}


def dominant_cause(sigma: Mapping[str, Any]) -> str:
    """Return the cause, of CAUSES, with the largest share in `StatedSigma.to_dict()`; '' where shares are not known."""
    share = {cause: part for cause, part in (sigma.get("share") or {}).items() if cause in CAUSES and part is not None}
    return max(share, key=lambda cause: share[cause]) if share else ""


def sigma_line(sigma: Mapping[str, Any], folder: Path, calibrated: bool = False) -> str:
    """Return the line of a run that ends, of `StatedSigma.to_dict()` and its folder: σ, what dominates it, and what would improve it; of a run that
    was `calibrated`, beyond that."""
    calibrate = STATE_SIGMAS if calibrated else f"trihedron calibrate {shlex.quote(str(folder))}"
    cures = {NOISE: f": {SEE_MORE}", CALIBRATED: f": {calibrate}", SCALED: f": {MEASURE}"}
    line = "σ of ok poses: " + ", ".join(f"{1e3 * sigma[f'{k}_m']:.1f} mm, {sigma[f'{k}_deg']:.2f}° ({k})" for k in ("median", "worst"))
    if cause := dominant_cause(sigma):
        line += f"; mostly {CAUSES[cause]}{cures.get(cause, '')}"
    if few := sigma["few_features"]:
        line += f"; {few} degraded frame{'s' * (few > 1)} show{'s' * (few == 1)} little of the map: {SEE_MORE}"
    return line
