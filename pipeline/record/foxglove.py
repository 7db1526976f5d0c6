"""Values under the well-known Foxglove schemas, so that a recording opens in a viewer without a converter.

Channels `/view/...`, `/tf` and `/error` mirror stage topics; nothing reads them back. World and camera frames are those of `types`.

- `/view/image` with `/view/camera`, half the size; `/view/features` draws key points and line segments on it;
- `/tf`, `/view/pose`, and `/view/path` in pieces of a second; `/view/lines`, `/view/planes` and `/view/axes` in the camera's frame;
- `/view/map_points`, `/view/map_lines`, `/view/surface`, `/view/building` in the world;
- `/view/truth` and `/error`, where the truth is known: aligned at the first tracked frame;
- `/view/log`: when the camera is lost or tracked badly, and why."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import rotation_angle_deg
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import (
    F64,
    LOST,
    OK,
    Building,
    Frame,
    Keypoints,
    ManhattanFrame,
    Map,
    Planes,
    Pose,
    Segments,
    Surface,
    Trajectory,
    Value,
)
from trihedron.pipeline.record import foxglove_messages as show

IMAGE_PERIOD_NS = 200_000_000  # drawing features takes a millisecond or two
MAP_PERIOD_NS = 1_000_000_000
MAP_POINTS = 5000  # a map of twice as many points is shown half as often
TRUTH_NS = 20_000_000  # largest time between a frame and its true pose
PERIODS_NS: dict[type[Value], int] = {  # least time between two shown values; 0: all are shown
    Pose: 0, Keypoints: 0, Surface: 0, Building: 0, Segments: IMAGE_PERIOD_NS, ManhattanFrame: IMAGE_PERIOD_NS, Frame: IMAGE_PERIOD_NS,
    Planes: IMAGE_PERIOD_NS, Map: MAP_PERIOD_NS,
}  # fmt: skip


def _error_class() -> Any:
    """The protobuf class of `trihedron.Error`: the error of a pose against the truth."""
    double, optional = descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE, descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL
    file = descriptor_pb2.FileDescriptorProto(name="trihedron/error.proto", package="trihedron", syntax="proto3")
    error = file.message_type.add(name="Error")
    for number, name in enumerate(("translation_m", "rotation_deg"), 1):
        error.field.add(name=name, number=number, type=double, label=optional)
    pool = descriptor_pool.Default()
    pool.Add(file) if hasattr(pool, "Add") else pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("trihedron.Error"))


ErrorMessage = _error_class()


class TopicView:
    """Turns values into viewer messages, thinned by the frames' stamps (so the same run gives the same messages). Poses are compared with `truth`."""

    def __init__(self, truth: Trajectory | None = None) -> None:
        self._last_ns: dict[str, int] = {}
        self._truth, self._T_world_truth = truth, None
        self._path: list[F64] = []
        self._status = OK
        self._pixels: dict[str, Any] = {}  # features to draw on the image of the current frame

    _T_world_truth: F64 | None

    def messages(self, value: Value) -> Iterator[tuple[str, Any]]:
        """Yield (channel, message) pairs of one value; none for values that are not shown."""
        return self.draw_messages(value) if self.wants(value) else iter(())

    def wants(self, value: Value) -> bool:
        """Return whether the value is to be drawn. Call it once for each value, in order."""
        period = PERIODS_NS.get(value.__class__)
        if isinstance(value, Map):
            period = MAP_PERIOD_NS * max(1, len(value.points) // MAP_POINTS)
        return period is not None and (period == 0 or self._due(type(value).__name__, value.stamp_ns, period))

    def draw_messages(self, value: Value) -> Iterator[tuple[str, Any]]:
        """Yield (channel, message) pairs of a value for which `wants` is True."""
        if isinstance(value, Pose):
            yield from self._pose_messages(value)
        elif isinstance(value, Keypoints):
            self._pixels = {"keypoints": value}
        elif isinstance(value, Segments):
            yield "/view/features", show.features(value, self._pixels.get("keypoints"))
            yield "/view/lines", show.lines(value)
        elif isinstance(value, ManhattanFrame):
            yield "/view/axes", show.axes(value)
        elif isinstance(value, Frame):
            yield "/view/camera", show.calibration(value)
            yield "/view/image", show.image(value)
        elif isinstance(value, Planes):
            yield "/view/planes", show.planes(value)
        elif isinstance(value, Map):
            yield "/view/map_points", show.map_points(value)
            if len(value.lines):
                yield "/view/map_lines", show.map_lines(value)
        elif isinstance(value, Surface) and len(value.triangles):
            yield "/view/surface", show.surface(value)
        elif isinstance(value, Building) and len(value.walls_m):
            yield "/view/building", show.solids(value, "building")

    def _pose_messages(self, pose: Pose) -> Iterator[tuple[str, Any]]:
        placed = show.in_frame(pose)
        yield "/view/pose", placed
        yield "/tf", show.transform(pose, placed)
        self._path.append(pose.T_world_camera[:3, 3])
        if self._due("path", pose.stamp_ns, MAP_PERIOD_NS):
            yield "/view/path", show.path(pose, self._path)
            self._path = self._path[-1:]
        if pose.status != self._status:
            self._status = pose.status
            level = Log.INFO if pose.status == OK else Log.ERROR if pose.status == LOST else Log.WARNING
            text = f"frame {pose.index}: {pose.status}" + (f", {pose.reason}" if pose.reason else "")
            yield "/view/log", Log(timestamp=show.stamp(pose), level=level, message=text, name="pose")
        T = self._true_pose(pose)
        if T is not None:
            yield "/view/truth", show.in_frame(pose, T)
            error = matmul(invert(T), pose.T_world_camera)
            translation_m = float(norm(error[:3, 3]))
            yield "/error", ErrorMessage(translation_m=translation_m, rotation_deg=float(rotation_angle_deg(error[:3, :3])))

    def _true_pose(self, pose: Pose) -> F64 | None:
        """The true pose in the world of the run, aligned at the first tracked frame."""
        if self._truth is None or pose.status == LOST or pose.submap != 0 or not len(self._truth):
            return None
        row = int(np.argmin(np.abs(self._truth.stamps_ns - pose.stamp_ns)))
        if abs(int(self._truth.stamps_ns[row]) - pose.stamp_ns) > TRUTH_NS:
            return None
        if self._T_world_truth is None:
            self._T_world_truth = matmul(pose.T_world_camera, invert(self._truth.poses[row]))
        return np.asarray(matmul(self._T_world_truth, self._truth.poses[row]))

    def _due(self, name: str, stamp_ns: int, period_ns: int) -> bool:
        last = self._last_ns.get(name)
        if last is not None and 0 <= stamp_ns - last < period_ns:
            return False
        self._last_ns[name] = stamp_ns
        return True
