"""ROS 2 messages (CDR) as images, intrinsics, transforms.

Messages are decoded by the definitions below, never by those a recording brings, which could steer the decoder.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from typing import Any

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from trihedron.datasets.readers.robot_values import Intrinsics, Link, Picture, UnreadableMessage, intrinsics, link

HEAD_BYTES = 12  # of a message that begins with a header: encapsulation, seconds, nanoseconds
DEFINITIONS = {  # of common_interfaces and geometry2, the same in every ROS 2 distribution
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "sensor_msgs/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/CameraInfo": "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
    "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p",  # binning and region of interest follow, which nothing here reads
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    "nav_msgs/Odometry": "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose",  # its twist is not read
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}


@cache
def _decoder(kind: str) -> Callable[[bytes], Any]:
    rest = "".join(f"\n{'=' * 80}\nMSG: {name}\n{text}" for name, text in DEFINITIONS.items() if name != kind)
    schema = Schema(id=1, name=kind.replace("/", "/msg/"), encoding="ros2msg", data=(DEFINITIONS[kind] + rest).encode())
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder


def _decode(kind: str, data: bytes) -> Any:
    try:
        return _decoder(kind)(data)
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise UnreadableMessage(f"is no {kind}") from error


def stamp_ns(data: bytes) -> int:
    """The stamp of a message that begins with a header, from its first `HEAD_BYTES`. Raises UnreadableMessage when it is shorter."""
    if len(data) < HEAD_BYTES:
        raise UnreadableMessage("is cut off")
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def image(data: bytes) -> Picture:
    """sensor_msgs/msg/Image."""
    m = _decode("sensor_msgs/Image", data)
    return Picture(stamp_ns(data), m.header.frame_id, m.encoding, m.data, False, m.width, m.height, m.step, bool(m.is_bigendian))


def compressed_image(data: bytes) -> Picture:
    """sensor_msgs/msg/CompressedImage, `compressedDepth` too."""
    m = _decode("sensor_msgs/CompressedImage", data)
    return Picture(stamp_ns(data), m.header.frame_id, m.format, m.data, True)


def camera_info(data: bytes) -> Intrinsics:
    """sensor_msgs/msg/CameraInfo."""
    m = _decode("sensor_msgs/CameraInfo", data)
    return intrinsics(m.header.frame_id, m.width, m.height, m.distortion_model, m.d, m.k, m.p)


def tf_message(data: bytes) -> list[Link]:
    """tf2_msgs/msg/TFMessage."""
    return [_link(transform) for transform in _decode("tf2_msgs/TFMessage", data).transforms]


def transform_stamped(data: bytes) -> list[Link]:
    """geometry_msgs/msg/TransformStamped."""
    return [_link(_decode("geometry_msgs/TransformStamped", data))]


def _link(m: Any) -> Link:
    t, q = m.transform.translation, m.transform.rotation
    return link(_stamp(m.header), m.header.frame_id, m.child_frame_id, [t.x, t.y, t.z], [q.x, q.y, q.z, q.w])


def _pose(header: Any, child: str, pose: Any) -> list[Link]:
    t, q = pose.position, pose.orientation
    return [link(_stamp(header), header.frame_id, child, [t.x, t.y, t.z], [q.x, q.y, q.z, q.w])]


def pose_stamped(data: bytes) -> list[Link]:
    """geometry_msgs/msg/PoseStamped."""
    m = _decode("geometry_msgs/PoseStamped", data)
    return _pose(m.header, "", m.pose)


def pose_with_covariance(data: bytes) -> list[Link]:
    """geometry_msgs/msg/PoseWithCovarianceStamped."""
    m = _decode("geometry_msgs/PoseWithCovarianceStamped", data)
    return _pose(m.header, "", m.pose.pose)


def odometry(data: bytes) -> list[Link]:
    """nav_msgs/msg/Odometry."""
    m = _decode("nav_msgs/Odometry", data)
    return _pose(m.header, m.child_frame_id, m.pose.pose)
