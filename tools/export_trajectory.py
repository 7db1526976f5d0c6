"""The final trajectory in the formats of TUM and KITTI, and everything recorded of each frame as a table (CSV)."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.app.recorded_values import poses_of, trajectory_of
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.geometry import quaternion_from_rotation
from trihedron.pipeline.core.types import Pose, Trajectory
from trihedron.pipeline.record.codec import TIMING_TOPIC, timing_of
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import format_stamp, write_trajectory
from trihedron.pipeline.run.consistency import judged_poses
from trihedron.tools.export import Format

SIGMAS = ("var_x", "var_y", "var_z", "var_rx", "var_ry", "var_rz")  # m² and rad², in the camera's frame
COUNTS = {"keypoints": "pixels", "segments": "endpoints_px", "planes": "coefficients"}  # rows that are counted
SIDECAR = ".cov"  # after the name of the trajectory
CONVENTION = (
    "#%TANGENT_CONVENTION right_perturbation",
    "#%TANGENT_ORDER translation_rotation",
    "# stamp c11 c21 c22 c31 ... c66: the lower triangle, row by row, in m and rad, of xi = (rho, phi) in T_world_camera = T_estimate Exp(xi)",
)
PAIRS = ("keypoints", "segments", "planes")


def write_tum(recording: Recording, path: Path) -> str:
    """`stamp tx ty tz qx qy qz qw`, camera in world."""
    trajectory = trajectory_of(recording)
    write_trajectory(path, trajectory)
    return f"{len(trajectory)} poses"


def write_tum_with_covariance(recording: Recording, path: Path) -> str:
    """Write the poses whose covariances are judged, as they were estimated at the time, and beside them the covariances (`write_covariances`). Raises
    DataError for a run without such poses."""
    poses = judged_poses(poses_of(recording))
    if not poses:
        raise DataError(str(recording.path), "has no tracked pose after the first, which is exact by definition", "record a longer run")
    write_trajectory(path, Trajectory(np.array([pose.stamp_ns for pose in poses], np.int64), np.array([pose.T_world_camera for pose in poses])))
    sidecar = path.with_name(path.name + SIDECAR)
    write_covariances(sidecar, poses)
    return f"{len(poses)} poses as they were estimated at the time, with their covariances in {sidecar}"


def write_covariances(path: Path, poses: list[Pose]) -> None:
    """Write a row for each pose, its stamp and the lower triangle of `Pose.covariance`, row by row: 22 numbers. That is the convention of smfeval:
    perturbation on the right, so in the camera frame, translation first, m and rad."""
    rows = (" ".join([format_stamp(pose.stamp_ns), *(f"{value:.12e}" for value in pose.covariance[np.tril_indices(6)])]) for pose in poses)
    write_file(path, "\n".join([*CONVENTION, *rows]) + "\n")


def write_kitti(recording: Recording, path: Path) -> str:
    """Twelve numbers a row: the upper three rows of `T_world_camera`. The format has no stamps, so rows are the tracked frames in order."""
    trajectory = trajectory_of(recording)
    np.savetxt(text := io.StringIO(), trajectory.poses[:, :3].reshape(-1, 12), fmt="%.9e")
    write_file(path, text.getvalue())
    return f"{len(trajectory)} poses, without stamps; frames that were lost have no row"


def write_csv(recording: Recording, path: Path) -> str:
    """A row a frame: the pose as estimated at the time, its status and variances, what the stages found, and their milliseconds."""
    columns: dict[int, dict[str, Any]] = {pose.index: _pose_columns(pose) for pose in poses_of(recording)}
    for topic in ("keypoints", "segments", "planes", "manhattan", "rotation", "tracks", "matches"):
        for value in recording.values(topic) if topic in recording.topics else ():
            if value.index in columns:
                columns[value.index] |= _stage_columns(topic, value)
    for _, data in recording.messages(TIMING_TOPIC):
        timing = timing_of(data)
        if timing["index"] in columns:
            columns[timing["index"]] |= {"frame_ms": timing["frame_ms"], **{f"ms_{stage}": ms for stage, ms in timing["stage_ms"].items()}}
    names = list(dict.fromkeys(name for row in columns.values() for name in row))
    writer = csv.DictWriter(text := io.StringIO(newline=""), names, restval="")
    writer.writeheader()
    writer.writerows(columns.values())
    write_file(path, text.getvalue())
    return f"{len(columns)} frames, {len(names)} columns"


def _pose_columns(pose: Pose) -> dict[str, Any]:
    x, y, z = (f"{v:.9f}" for v in pose.T_world_camera[:3, 3])
    qx, qy, qz, qw = (f"{v:.9f}" for v in quaternion_from_rotation(pose.T_world_camera[:3, :3]))
    row = {"index": pose.index, "stamp": format_stamp(pose.stamp_ns), "status": pose.status, "reason": pose.reason}
    row |= {"tx": x, "ty": y, "tz": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
    row |= {name: f"{variance:.6e}" for name, variance in zip(SIGMAS, np.diag(pose.covariance))}
    row |= {f"inliers_{kind}": int(n) for kind, n in zip(("points", "lines", "planes"), pose.inliers)}
    return row | {"unobservable": pose.unobservable, "reference": pose.reference, "submap": pose.submap}


def _stage_columns(topic: str, value: Any) -> dict[str, Any]:
    if topic in COUNTS:
        return {topic: len(getattr(value, COUNTS[topic]))}
    if topic == "manhattan":
        return {"manhattan_supported": int(value.supported)}
    if topic == "rotation":
        return {"rotation_source": value.source}
    return {f"{topic}_{kind}": len(getattr(value, kind)) for kind in PAIRS}


FORMATS = (
    Format("tum", "trajectory_final.txt", write_tum, {"covariance": Format("tum", "trajectory_estimated.txt", write_tum_with_covariance)}),
    Format("kitti", "trajectory_kitti.txt", write_kitti),
    Format("csv", "frames.csv", write_csv),
)
