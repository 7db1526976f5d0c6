"""The final trajectory in the formats of TUM and KITTI, and everything recorded of each frame as a table (CSV)."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.app.recorded_values import poses_of, trajectory_of
from trihedron.pipeline.core.geometry import quaternion_from_rotation
from trihedron.pipeline.core.types import Pose
from trihedron.pipeline.record.codec import TIMING_TOPIC, timing_of
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import format_stamp, write_trajectory
from trihedron.tools.export import Format

SIGMAS = ("var_x", "var_y", "var_z", "var_rx", "var_ry", "var_rz")  # m² and rad², in the camera's frame
COUNTS = {"keypoints": "pixels", "segments": "endpoints_px", "planes": "coefficients"}  # rows that are counted
PAIRS = ("keypoints", "segments", "planes")


def write_tum(recording: Recording, path: Path) -> str:
    """`stamp tx ty tz qx qy qz qw`, camera in world."""
    trajectory = trajectory_of(recording)
    write_trajectory(path, trajectory)
    return f"{len(trajectory)} poses"


def write_kitti(recording: Recording, path: Path) -> str:
    """Twelve numbers a row: the upper three rows of `T_world_camera`. The format has no stamps, so rows are the tracked frames in order."""
    trajectory = trajectory_of(recording)
    np.savetxt(path, trajectory.poses[:, :3].reshape(-1, 12), fmt="%.9e")
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
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(columns.values())
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
    Format("tum", "trajectory_final.txt", write_tum),
    Format("kitti", "trajectory_kitti.txt", write_kitti),
    Format("csv", "frames.csv", write_csv),
)
