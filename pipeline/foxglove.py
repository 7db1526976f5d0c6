"""What people look at, under the well-known Foxglove schemas, so that a recording opens in a viewer without a converter.

Channels `/view/...` and `/tf` mirror stage topics; nothing reads them back. World and camera frames are those of `types`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration
from google.protobuf.timestamp_pb2 import Timestamp

from trihedron.pipeline.geometry import quaternion_from_rotation, tangent_basis
from trihedron.pipeline.types import F32, I32, Frame, Map, Planes, Pose, Segments, Surface, Value

WORLD, CAMERA = "world", "camera"
IMAGE_PERIOD_NS = 100_000_000  # 10 Hz is enough to look at
MAP_PERIOD_NS = 1_000_000_000
JPEG_QUALITY = 80
MOST_VERTICES = 30_000  # of a mesh, 70 bytes each
COARSE_M = 0.02  # side of the cells whose vertices become one when there are more; doubled until there are not
COLORS = ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16), (0.58, 0.4, 0.74), (0.55, 0.34, 0.29), (0.89, 0.47, 0.76))
IDENTITY = PoseMessage(position=Vector3(), orientation=Quaternion(w=1.0))


class View:
    """Turns values into viewer messages, thinned by the frames' stamps (so the same run gives the same messages)."""

    def __init__(self) -> None:
        self._last_ns: dict[str, int] = {}

    def messages(self, value: Value) -> Iterator[tuple[str, Any]]:
        """(channel, message) pairs of one value; none for values nobody looks at."""
        if isinstance(value, Pose):
            yield "/view/pose", _pose(value)
            yield "/tf", _transform(value)
        elif isinstance(value, Frame) and self._due("image", value.stamp_ns, IMAGE_PERIOD_NS):
            yield "/view/camera", _calibration(value)
            yield "/view/image", _image(value)
        elif isinstance(value, Planes) and self._due("planes", value.stamp_ns, IMAGE_PERIOD_NS):
            yield "/view/planes", _planes(value)
        elif isinstance(value, Segments) and self._due("lines", value.stamp_ns, IMAGE_PERIOD_NS):
            yield "/view/lines", _lines(value)
        elif isinstance(value, Map) and self._due("map", value.stamp_ns, MAP_PERIOD_NS):
            yield "/view/map_points", _map_points(value)
        elif isinstance(value, Surface) and len(value.triangles):
            yield "/view/surface", _surface(value)

    def _due(self, name: str, stamp_ns: int, period_ns: int) -> bool:
        last = self._last_ns.get(name)
        if last is not None and 0 <= stamp_ns - last < period_ns:
            return False
        self._last_ns[name] = stamp_ns
        return True


def _stamp(value: Value) -> Timestamp:
    return Timestamp(seconds=value.stamp_ns // 1_000_000_000, nanos=value.stamp_ns % 1_000_000_000)


def _position_and_quaternion(pose: Pose) -> tuple[Vector3, Quaternion]:
    x, y, z = map(float, pose.T_world_camera[:3, 3])
    qx, qy, qz, qw = map(float, quaternion_from_rotation(pose.T_world_camera[:3, :3]))
    return Vector3(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=qw)


def _pose(pose: Pose) -> PoseInFrame:
    position, orientation = _position_and_quaternion(pose)
    return PoseInFrame(timestamp=_stamp(pose), frame_id=WORLD, pose=PoseMessage(position=position, orientation=orientation))


def _transform(pose: Pose) -> FrameTransform:
    position, orientation = _position_and_quaternion(pose)
    return FrameTransform(timestamp=_stamp(pose), parent_frame_id=WORLD, child_frame_id=CAMERA, translation=position, rotation=orientation)


def _calibration(frame: Frame) -> CameraCalibration:
    """Of the half-size image beside it."""
    c = frame.camera
    fx, fy, cx, cy = c.fx / 2, c.fy / 2, (c.cx + 0.5) / 2 - 0.5, (c.cy + 0.5) / 2 - 0.5
    return CameraCalibration(
        timestamp=_stamp(frame),
        frame_id=CAMERA,
        width=c.width // 2,
        height=c.height // 2,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    )


def _image(frame: Frame) -> CompressedImage:
    half = cv2.resize(frame.color, (frame.camera.width // 2, frame.camera.height // 2), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", cv2.cvtColor(half, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return CompressedImage(timestamp=_stamp(frame), frame_id=CAMERA, data=data.tobytes(), format="jpeg")


def _scene(value: Value, name: str, **primitives: Any) -> SceneUpdate:
    lifetime = Duration(nanos=2 * IMAGE_PERIOD_NS)
    return SceneUpdate(entities=[SceneEntity(timestamp=_stamp(value), frame_id=CAMERA, id=name, lifetime=lifetime, **primitives)])


def _planes(planes: Planes) -> SceneUpdate:
    """Each region as the convex hull of its samples, in the camera frame."""
    triangles = []
    for i, plane in enumerate(planes.coefficients):
        samples = planes.samples_m[i][np.isfinite(planes.samples_m[i, :, 0])].astype(np.float64)
        if len(samples) < 3:
            continue
        flat = (samples @ tangent_basis(plane[:3])).astype(np.float32)
        hull = samples[cv2.convexHull(flat, returnPoints=False)[:, 0]]
        fan = [hull[k] for j in range(1, len(hull) - 1) for k in (0, j, j + 1)]
        r, g, b = COLORS[i % len(COLORS)]
        triangles.append(TriangleListPrimitive(points=[_point(p) for p in fan], color=Color(r=r, g=g, b=b, a=0.5)))
    return _scene(planes, "planes", triangles=triangles)


def _lines(segments: Segments) -> SceneUpdate:
    seen = np.isfinite(segments.endpoints_m).all(axis=(1, 2))
    points = [_point(p) for p in segments.endpoints_m[seen].reshape(-1, 3)]
    color = Color(r=0.9, g=0.2, b=0.2, a=1.0)
    lines = LinePrimitive(type=LinePrimitive.LINE_LIST, thickness=2.0, scale_invariant=True, points=points, color=color)
    return _scene(segments, "lines", lines=[lines])


def _point(p: Any) -> Point3:
    return Point3(x=float(p[0]), y=float(p[1]), z=float(p[2]))


def _map_points(map: Map) -> PointCloud:
    points = map.points.column("position_m")[map.points.column("alive")].astype("<f4")
    fields = [PackedElementField(name=axis, offset=4 * i, type=PackedElementField.FLOAT32) for i, axis in enumerate("xyz")]
    return PointCloud(timestamp=_stamp(map), frame_id=WORLD, pose=IDENTITY, point_stride=12, fields=fields, data=points.tobytes())


def _surface(surface: Surface) -> SceneUpdate:
    """The mesh, coarser where it would be too large, in the world; it stays."""
    first, triangles = _coarse(surface.vertices_m, surface.triangles)
    points = [_point(p) for p in surface.vertices_m[first]]
    colors = [Color(r=r, g=g, b=b, a=1.0) for r, g, b in (surface.colors[first] / 255.0).tolist()]
    mesh = TriangleListPrimitive(pose=IDENTITY, points=points, colors=colors, indices=triangles.ravel().tolist())
    return SceneUpdate(entities=[SceneEntity(timestamp=_stamp(surface), frame_id=WORLD, id="surface", triangles=[mesh])])


def _coarse(vertices: F32, triangles: I32) -> tuple[I32, I32]:
    """Rows (n,) of the vertices shown, MOST_VERTICES at most, and triangles (t, 3) of these: the first vertex of each cell stands for all in it."""
    first, number, side = np.arange(len(vertices)), np.arange(len(vertices)), COARSE_M
    while len(first) > MOST_VERTICES:
        _, first, number = np.unique(np.floor(vertices / side).astype(np.int64), axis=0, return_index=True, return_inverse=True)
        side *= 2.0
    shown = number.ravel()[triangles]
    whole = (shown != shown[:, [1, 2, 0]]).all(axis=1)
    return first.astype(np.int32), shown[whole].astype(np.int32)
