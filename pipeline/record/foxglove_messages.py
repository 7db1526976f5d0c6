"""Values as messages under the well-known Foxglove schemas; world and camera frames are those of `types`."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration
from google.protobuf.timestamp_pb2 import Timestamp

from trihedron.pipeline.core.geometry import quaternion_from_rotation, tangent_basis
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.registry import drawing_of
from trihedron.pipeline.core.types import (  # fmt: skip
    F32,
    F64,
    I32,
    Frame,
    Keypoints,
    ManhattanFrame,
    Map,
    Planes,
    Pose,
    Segments,
    Surface,
    Value,
)

WORLD, CAMERA = "world", "camera"
LIFETIME_NS = 400_000_000  # of what belongs to a frame
JPEG_QUALITY = 80
MOST_VERTICES = 30_000  # of a mesh, 70 bytes each
COARSE_M = 0.02  # side of the cells whose vertices become one when there are more; doubled until there are not
COLORS = ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16), (0.58, 0.4, 0.74), (0.55, 0.34, 0.29), (0.89, 0.47, 0.76))
AXES = ((0.86, 0.2, 0.2), (0.2, 0.67, 0.2), (0.24, 0.35, 0.9))
IDENTITY = PoseMessage(position=Vector3(), orientation=Quaternion(w=1.0))


def stamp(value: Value) -> Timestamp:
    """Make a time stamp."""
    return Timestamp(seconds=value.stamp_ns // 1_000_000_000, nanos=value.stamp_ns % 1_000_000_000)


def _position_and_quaternion(T: F64) -> tuple[Vector3, Quaternion]:
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_rotation(T[:3, :3]).tolist()
    return Vector3(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=qw)


def in_frame(pose: Pose, T: F64 | None = None) -> PoseInFrame:
    """Make a message of the camera's pose, or of T (4, 4)."""
    position, orientation = _position_and_quaternion(pose.T_world_camera if T is None else T)
    return PoseInFrame(timestamp=stamp(pose), frame_id=WORLD, pose=PoseMessage(position=position, orientation=orientation))


def transform(pose: Pose, placed: PoseInFrame) -> FrameTransform:
    """Make the transform from the world to the camera at `in_frame`."""
    position, orientation = placed.pose.position, placed.pose.orientation
    return FrameTransform(timestamp=stamp(pose), parent_frame_id=WORLD, child_frame_id=CAMERA, translation=position, rotation=orientation)


def calibration(frame: Frame) -> CameraCalibration:
    """Make the calibration of the half-size image."""
    c = frame.camera
    fx, fy, cx, cy = c.fx / 2, c.fy / 2, (c.cx + 0.5) / 2 - 0.5, (c.cy + 0.5) / 2 - 0.5
    return CameraCalibration(
        timestamp=stamp(frame),
        frame_id=CAMERA,
        width=c.width // 2,
        height=c.height // 2,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    )


def image(frame: Frame) -> CompressedImage:
    """The colour image, half the size."""
    half = cv2.resize(frame.color, (frame.camera.width // 2, frame.camera.height // 2), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", cv2.cvtColor(half, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return CompressedImage(timestamp=stamp(frame), frame_id=CAMERA, data=data.tobytes(), format="jpeg")


def _scene(value: Value, name: str) -> tuple[SceneUpdate, SceneEntity]:
    """A scene, and what it holds, to be filled in place: what a message is made of is copied."""
    update = SceneUpdate()
    return update, update.entities.add(timestamp=stamp(value), frame_id=CAMERA, id=name, lifetime=Duration(nanos=LIFETIME_NS))


def _in_world(value: Value, name: str) -> tuple[SceneUpdate, SceneEntity]:
    """Make a scene like `_scene` that stays until another of this name comes."""
    update = SceneUpdate()
    return update, update.entities.add(timestamp=stamp(value), frame_id=WORLD, id=name)


def _fill(message: Any, field: str, rows: Any) -> None:
    """Add rows (n, k) to a field that repeats messages of k doubles (points, colours): their bytes at once, not object by object."""
    message.MergeFromString(_encode_repeated(message, field, rows).tobytes())


def _encode_repeated(message: Any, field: str, rows: Any) -> Any:
    """Rows (n, k) as bytes (n,) of a field that repeats messages of k doubles."""
    rows = np.asarray(rows, np.float64).reshape(-1, rows.shape[-1])
    packed = np.zeros(len(rows), _packed_dtype(rows.shape[1]))
    packed["tag"], packed["size"] = message.DESCRIPTOR.fields_by_name[field].number << 3 | 2, 9 * rows.shape[1]
    for i in range(rows.shape[1]):
        packed[f"key{i}"], packed[f"value{i}"] = (i + 1) << 3 | 1, rows[:, i]
    return packed


@cache
def _packed_dtype(doubles: int) -> np.dtype[Any]:
    """The bytes of a message of so many doubles in a field."""
    return np.dtype([("tag", "u1"), ("size", "u1"), *((f"{part}{i}", kind) for i in range(doubles) for part, kind in _DOUBLE)])


_DOUBLE = (("key", "u1"), ("value", "<f8"))


def features(segments: Segments, keypoints: Keypoints | None) -> ImageAnnotations:
    """Key points and segments, to a quarter of a pixel, on the half-size image."""
    when = stamp(segments)
    drawn = ImageAnnotations(timestamp=when)
    if keypoints is not None:
        green = _color((0.0, 0.9, 0.47), 1.0)
        points = drawn.points.add(timestamp=when, type=PointsAnnotation.POINTS, outline_color=green, thickness=2.0)
        _fill(points, "points", _half(keypoints.pixels))
    yellow = _color((1.0, 0.9, 0.0), 1.0)
    lines = drawn.points.add(timestamp=when, type=PointsAnnotation.LINE_LIST, outline_color=yellow, thickness=1.0)
    _fill(lines, "points", _half(segments.endpoints_px))
    return drawn


def _half(pixels: F32) -> F64:
    return np.asarray(np.rint(2.0 * pixels.astype(np.float64) - 1.0) / 4.0)


def planes(planes: Planes) -> SceneUpdate:
    """Each region as the convex hull of its samples, in the camera frame."""
    update, entity = _scene(planes, "planes")
    samples, points = planes.samples_m, _encode_repeated(TriangleListPrimitive, "points", planes.samples_m).reshape(planes.samples_m.shape[:2])
    flat = matmul(samples, tangent_basis(planes.coefficients[:, :3])).astype(np.float32)
    for i, finite in enumerate(np.isfinite(samples[:, :, 0])):
        seen = np.flatnonzero(finite)
        if len(seen) < 3:
            continue
        hull = cv2.convexHull(flat[i, seen], returnPoints=False)[:, 0]
        triangles = entity.triangles.add(color=_color(COLORS[i % len(COLORS)], 0.5))
        triangles.MergeFromString(points[i, seen[hull[_fan(len(hull))]]].tobytes())
    return update


@cache
def _fan(corners: int) -> Any:
    """The triangles of a convex polygon: numbers of its corners."""
    middle = np.arange(1, corners - 1)
    return np.stack([0 * middle, middle, middle + 1], axis=1).ravel()


def lines(segments: Segments) -> SceneUpdate:
    """The segments that have depth, in the camera frame."""
    seen = np.isfinite(segments.endpoints_m).all(axis=(1, 2))
    update, entity = _scene(segments, "lines")
    _add_line(entity, segments.endpoints_m[seen], (0.9, 0.2, 0.2))
    return update


def _add_line(entity: SceneEntity, endpoints_m: Any, color: tuple[float, float, float], kind: Any = LinePrimitive.LINE_LIST) -> None:
    _fill(entity.lines.add(type=kind, thickness=2.0, scale_invariant=True, color=_color(color, 1.0)), "points", endpoints_m)


@cache
def _color(rgb: tuple[float, float, float], opacity: float) -> Color:
    r, g, b = rgb
    return Color(r=r, g=g, b=b, a=opacity)


def axes(found: ManhattanFrame) -> SceneUpdate:
    """The axes of the first Manhattan frame as arrows half a metre long, a metre and a half before the camera; none when it is not supported."""
    update, entity = _scene(found, "axes")
    for color, axis in zip(AXES, found.rotations[0].T.tolist() if found.supported and len(found.rotations) else ()):
        pose = PoseMessage(position=Vector3(z=1.5), orientation=_turn_of_x(*axis))
        entity.arrows.add(pose=pose, shaft_length=0.4, shaft_diameter=0.02, head_length=0.1, head_diameter=0.05, color=_color(color, 1.0))
    return update


def _turn_of_x(x: float, y: float, z: float) -> Quaternion:
    """The shortest turn that lays the x-axis on a unit vector: an arrow points along its own x."""
    if x < -1.0 + 1e-9:
        return Quaternion(z=1.0)
    w = math.sqrt(0.5 + 0.5 * x)  # cosine of half the angle
    return Quaternion(y=-0.5 * z / w, z=0.5 * y / w, w=w)


def path(pose: Pose, positions: list[F64]) -> SceneUpdate:
    """Make the path of the camera since the last piece."""
    update, entity = _in_world(pose, f"path until {pose.index}")
    _add_line(entity, np.array(positions), (0.86, 0.08, 0.24), LinePrimitive.LINE_STRIP)
    return update


def map_lines(map: Map) -> SceneUpdate:
    """The living lines of the map."""
    update, entity = _in_world(map, "map lines")
    _add_line(entity, map.lines.column("endpoints_m")[map.lines.column("alive")], (0.12, 0.47, 0.71))
    return update


def map_points(map: Map) -> PointCloud:
    """The living points of the map."""
    points = map.points.column("position_m")[map.points.column("alive")].astype("<f4")
    fields = [PackedElementField(name=axis, offset=4 * i, type=PackedElementField.FLOAT32) for i, axis in enumerate("xyz")]
    return PointCloud(timestamp=stamp(map), frame_id=WORLD, pose=IDENTITY, point_stride=12, fields=fields, data=points.tobytes())


def surface(surface: Surface) -> SceneUpdate:
    """The mesh, coarser where it would be too large, in the world; it stays."""
    first, triangles = _coarse(surface.vertices_m, surface.triangles)
    update, entity = _in_world(surface, "surface")
    mesh = entity.triangles.add(pose=IDENTITY, indices=triangles.ravel().tolist())
    _fill(mesh, "points", surface.vertices_m[first])
    _fill(mesh, "colors", np.column_stack([surface.colors[first] / 255.0, np.ones(len(first))]))
    return update


def solids(value: Value, name: str) -> SceneUpdate:
    """Make the solids that a value's slot draws of it, in the world; they stay."""
    update, entity = _in_world(value, name)
    for solid in drawing_of(value).solids:
        r, g, b, a = solid.rgba
        mesh = entity.triangles.add(
            pose=IDENTITY, indices=solid.triangles.ravel().tolist(), color=_color((r / 255.0, g / 255.0, b / 255.0), a / 255.0)
        )
        _fill(mesh, "points", solid.vertices_m)
    return update


def _coarse(vertices: F32, triangles: I32) -> tuple[I32, I32]:
    """Rows (n,) of the vertices shown, MOST_VERTICES at most, and triangles (t, 3) of these: the first vertex of each cell stands for all in it."""
    first, number, side = np.arange(len(vertices)), np.arange(len(vertices)), COARSE_M
    while len(first) > MOST_VERTICES:
        _, first, number = np.unique(np.floor(vertices / side).astype(np.int64), axis=0, return_index=True, return_inverse=True)
        side *= 2.0
    shown = number.ravel()[triangles]
    whole = (shown != shown[:, [1, 2, 0]]).all(axis=1)
    return first.astype(np.int32), shown[whole].astype(np.int32)
