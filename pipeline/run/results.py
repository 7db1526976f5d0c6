"""The files of a run folder besides the recording: trajectories, timing, metrics."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import DEGRADED, LOST, OK, Map, Pose, Trajectory
from trihedron.pipeline.record.trajectories import write_trajectory
from trihedron.pipeline.run.accounting import Result
from trihedron.pipeline.run.consistency import judged_poses, pose_consistency, truth_noise
from trihedron.pipeline.run.metrics import associate, evaluate_trajectory
from trihedron.pipeline.run.stated_sigma import stated_sigma
from trihedron.pipeline.run.status_check import without_figures

TRAJECTORY, CAUSAL, TIMING, METRICS = "trajectory.txt", "trajectory_causal.txt", "timing.json", "metrics.json"
PLOT = "trajectory.png"
OF_POSES = (TRAJECTORY, CAUSAL, METRICS, PLOT)  # where there are some


def causal_trajectory(result: Result) -> Trajectory:
    """Return the tracked poses as they were estimated at the time, without those in a sub-map, which are in another world."""
    poses = [pose for pose in result.poses if pose.status != LOST and pose.submap == 0]
    return _trajectory([pose.stamp_ns for pose in poses], [pose.T_world_camera for pose in poses])


def final_trajectory(result: Result) -> Trajectory:
    """Return the tracked poses relative to the final keyframes: keyframe pose × relative pose, so that corrections of the map apply to every frame. A
    frame that became a keyframe has its pose. Frames of sub-maps are included once these are merged with the first."""
    poses = [pose for pose in result.poses if is_merged(pose, result.map)]
    if result.map is None:
        return causal_trajectory(result)
    keyframes = result.map.keyframes.column("T_world_camera")
    own = dict(list(zip(result.map.keyframes.column("index").tolist(), keyframes))[result.loaded_keyframes :])
    moved = [pose.T_world_camera if pose.reference < 0 else matmul(keyframes[pose.reference], pose.T_reference_camera) for pose in poses]
    return _trajectory([pose.stamp_ns for pose in poses], [own.get(pose.index, T) for pose, T in zip(poses, moved)])


def is_merged(pose: Pose, map: Map | None) -> bool:
    """Return True if the pose was tracked and is, in the end, in the world of the first frame."""
    if pose.status == LOST or map is None or pose.reference < 0:
        return pose.status != LOST and pose.submap == 0
    return bool(map.keyframes.rows("submap", np.array([pose.reference]))[0] == 0)


def _trajectory(stamps_ns: list[int], poses: list[Any]) -> Trajectory:
    return Trajectory(np.array(stamps_ns, np.int64), np.array(poses, np.float64).reshape(-1, 4, 4))


def with_unpacked_poses(result: Result) -> Result:
    """Return a result whose poses are a list: those of a run are packed, and unpacked at each reading."""
    return replace(result, poses=list(result.poses))


def write_results(out: Path, result: Result, final: Trajectory, truth: Trajectory | None) -> dict[str, Any]:
    """Write the final and the causal trajectory and, with ground truth, metrics; return the metrics. Statuses are counted and σ is
    stated in any case."""
    causal = causal_trajectory(result)
    write_trajectory(out / TRAJECTORY, final)
    write_trajectory(out / CAUSAL, causal)
    metrics: dict[str, Any] = {
        "frames": len(result.stamps_ns),
        "unreadable": result.unreadable,
        "unmerged": sum(pose.status != LOST and not is_merged(pose, result.map) for pose in result.poses),
        "status": {status: sum(pose.status == status for pose in result.poses) for status in (OK, DEGRADED, LOST)},
        "reasons": {status: reason for status in (DEGRADED, LOST) if (reason := _commonest_reason(result.poses, status))},
    }
    if sigma := stated_sigma(result.poses, result.calibration_m2):
        metrics["sigma"] = sigma.to_dict()
    if len(final):  # of a walk that ends where it began, the drift
        metrics["start_to_end_m"] = float(norm(final.poses[-1, :3, 3] - final.poses[0, :3, 3]))
    if truth is not None:
        stamps = np.array(result.stamps_ns, np.int64)
        try:
            for name, trajectory in (("final", final), ("causal", causal)):
                metrics[name] = evaluate_trajectory(trajectory, truth, fps=result.fps, frame_stamps_ns=stamps).to_dict()
            metrics["consistency"] = _consistency(result, truth)
        except DataError as error:
            metrics["note"] = str(error)
    write_json(out / METRICS, metrics)
    return metrics


def _commonest_reason(poses: Iterable[Pose], status: str) -> str:
    """Return the reason that most frames of a status have, as the last of them has it; reasons that differ in numbers alone are one. '' for none."""
    reasons = [pose.reason for pose in poses if pose.status == status]
    alike = list(map(without_figures, reasons))
    commonest = Counter(alike).most_common(1)
    return next((reason for reason, kind in zip(reversed(reasons), reversed(alike)) if kind == commonest[0][0]), "")


def _consistency(result: Result, truth: Trajectory) -> dict[str, Any]:
    """Return the consistency of the poses that are judged."""
    poses = judged_poses(result.poses)
    pairs = associate(np.array([pose.stamp_ns for pose in poses], np.int64), truth.stamps_ns)
    known = [poses[row] for row, _ in pairs]
    if len(known) < 2:
        return {}
    estimated, true = np.array([pose.T_world_camera for pose in known]), truth.poses[pairs[:, 1]]
    local = np.array([pose.covariance - pose.map_covariance for pose in known])
    noise = truth_noise(estimated, local, true, np.array([pose.index for pose in known], np.int32))
    return pose_consistency(estimated, np.array([pose.covariance for pose in known]), true, noise).to_dict()


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a dictionary as indented JSON."""
    write_file(path, json.dumps(content, indent=2) + "\n")


def flatten_dict(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries: values by dotted name, as `final.ate_rmse_m`."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten_dict(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
