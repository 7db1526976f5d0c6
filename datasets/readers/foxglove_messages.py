"""Messages of Foxglove's schemas (protobuf or JSON) as images, intrinsics, transforms."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError

from trihedron.datasets.readers.robot_values import Intrinsics, Link, Picture, UnreadableMessage, intrinsics, link


def _image(m: Any) -> Picture:
    return Picture(_stamp(m), _text(m.frame_id), _text(m.encoding), _bytes(m.data), False, int(m.width), int(m.height), int(m.step))


def _compressed_image(m: Any) -> Picture:
    return Picture(_stamp(m), _text(m.frame_id), _text(m.format), _bytes(m.data), True)


def _calibration(m: Any) -> Intrinsics:
    return intrinsics(_text(m.frame_id), int(m.width), int(m.height), _text(m.distortion_model), m.D, m.K, m.P)


def _transform(m: Any) -> list[Link]:
    return [_link(m, m.parent_frame_id, m.child_frame_id, m.translation, m.rotation)]


def _transforms(m: Any) -> list[Link]:
    return [_transform(one)[0] for one in m.transforms]


def _pose(m: Any) -> list[Link]:
    return [_link(m, m.frame_id, "", m.pose.position, m.pose.orientation)]


def _link(m: Any, parent: str, child: str, t: Any, q: Any) -> Link:
    return link(_stamp(m), _text(parent), _text(child), [t.x, t.y, t.z], [q.x, q.y, q.z, q.w])


def _stamp(m: Any) -> int:
    seconds, rest = (m.timestamp.sec, m.timestamp.nsec) if isinstance(m, SimpleNamespace) else (m.timestamp.seconds, m.timestamp.nanos)
    stamp = int(seconds) * 1_000_000_000 + int(rest)
    if abs(stamp) >= 2**62:
        raise UnreadableMessage("has a stamp that is too large")
    return stamp


def _text(value: Any) -> str:
    """A text, which JSON of a stranger may lack."""
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} instead of a text")
    return value


def _bytes(data: Any) -> bytes:
    """Bytes of protobuf, or base64 of JSON; a list of numbers is accepted too. A number would ask for as many bytes."""
    if not isinstance(data, (str, bytes, list)):
        raise TypeError(f"{type(data).__name__} instead of bytes")
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)


READERS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "foxglove.RawImage": (RawImage, _image),
    "foxglove.CompressedImage": (CompressedImage, _compressed_image),
    "foxglove.CameraCalibration": (CameraCalibration, _calibration),
    "foxglove.FrameTransform": (FrameTransform, _transform),
    "foxglove.FrameTransforms": (FrameTransforms, _transforms),
    "foxglove.PoseInFrame": (PoseInFrame, _pose),
}


def reader(kind: str, encoding: str) -> Callable[[bytes], Any]:
    """Return a decoder of messages of type `kind` (a key of READERS) as `protobuf` or `json`; it raises UnreadableMessage."""
    message, convert = READERS[kind]

    def read(data: bytes) -> Any:
        try:
            if encoding == "protobuf":
                return convert(message.FromString(data))
            return convert(json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields)))
        except (DecodeError, AttributeError, TypeError, ValueError, OverflowError, RecursionError, binascii.Error) as error:
            raise UnreadableMessage(f"is no {kind}") from error

    return read
