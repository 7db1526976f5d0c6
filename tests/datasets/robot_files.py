"""Recordings as robots make them, written with libraries that share no code with the reader: messages by rosbags, files by rosbags or mcap."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from trihedron.pipeline.core.geometry import quaternion_from_rotation

STORE = get_typestore(Stores.ROS2_HUMBLE)
SECOND = 1_000_000_000
COLOR, DEPTH = "camera_color_optical_frame", "camera_depth_optical_frame"
Message = tuple[str, str, int, bytes]  # topic, type, log time in ns, CDR


def make(kind: str, **fields: Any) -> Any:
    """A message of a type such as sensor_msgs/msg/Image."""
    return STORE.types[kind](**fields)


def header(stamp_ns: int, frame_id: str) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def message(topic: str, kind: str, log_time: int, content: Any, little_endian: bool = True) -> Message:
    return topic, kind, log_time, bytes(STORE.serialize_cdr(content, kind, little_endian=little_endian))


def image(topic: str, stamp_ns: int, frame_id: str, encoding: str, pixels: np.ndarray, *, pad: int = 0, big_endian: bool = False) -> Message:
    """sensor_msgs/Image; `pad` bytes of rubbish follow each row."""
    swapped = pixels.astype(pixels.dtype.newbyteorder(">")) if big_endian else pixels
    rows = np.ascontiguousarray(swapped).reshape(len(pixels), -1).view(np.uint8)
    data = np.concatenate([rows, np.full((len(rows), pad), 0xEE, np.uint8)], axis=1)
    fields = {"height": pixels.shape[0], "width": pixels.shape[1], "encoding": encoding, "is_bigendian": int(big_endian)}
    content = make("sensor_msgs/msg/Image", header=header(stamp_ns, frame_id), **fields, step=data.shape[1], data=data.reshape(-1))
    return message(topic, "sensor_msgs/msg/Image", stamp_ns + 3_000_000, content)


def compressed(topic: str, stamp_ns: int, frame_id: str, form: str, data: bytes) -> Message:
    kind = "sensor_msgs/msg/CompressedImage"
    content = make(kind, header=header(stamp_ns, frame_id), format=form, data=np.frombuffer(data, np.uint8))
    return message(topic, kind, stamp_ns + 3_000_000, content)


def encoded(extension: str, pixels: np.ndarray) -> bytes:
    return cv2.imencode(extension, pixels)[1].tobytes()


def camera_info(
    topic: str, stamp_ns: int, frame_id: str, size: tuple[int, int], K: Any, D: Any = (), model: str = "plumb_bob", P: Any = None
) -> Message:
    """sensor_msgs/CameraInfo; size is width, height."""
    kind = "sensor_msgs/msg/CameraInfo"
    K = np.array(K, float).reshape(3, 3)
    P = np.column_stack([K, np.zeros(3)]) if P is None else np.array(P, float)
    roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    fields = {"d": np.array(D, float), "k": K.reshape(-1), "r": np.eye(3).reshape(-1), "p": P.reshape(-1), "binning_x": 0, "binning_y": 0, "roi": roi}
    content = make(kind, header=header(stamp_ns, frame_id), height=size[1], width=size[0], distortion_model=model, **fields)
    return message(topic, kind, stamp_ns, content)


def transforms(topic: str, links: Iterable[tuple[int, str, str, np.ndarray]]) -> Message:
    """tf2_msgs/TFMessage of (stamp, parent, child, T_parent_child)."""
    found = []
    for stamp_ns, parent, child, T in links:
        x, y, z, w = quaternion_from_rotation(T[:3, :3])
        translation = make("geometry_msgs/msg/Vector3", x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
        transform = make("geometry_msgs/msg/Transform", translation=translation, rotation=_quaternion(x, y, z, w))
        found.append(make("geometry_msgs/msg/TransformStamped", header=header(stamp_ns, parent), child_frame_id=child, transform=transform))
    stamp = found[0].header.stamp
    content = make("tf2_msgs/msg/TFMessage", transforms=found)
    return message(topic, "tf2_msgs/msg/TFMessage", stamp.sec * SECOND + stamp.nanosec, content)


def pose(T: np.ndarray) -> Any:
    x, y, z, w = quaternion_from_rotation(T[:3, :3])
    point = make("geometry_msgs/msg/Point", x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
    return make("geometry_msgs/msg/Pose", position=point, orientation=_quaternion(x, y, z, w))


def _quaternion(x: float, y: float, z: float, w: float) -> Any:
    return make("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))


def write_bag(path: Path, messages: Iterable[Message], zstd: bool = False) -> Path:
    """A folder as `ros2 bag record -s mcap` makes it, by rosbags; returns its .mcap file."""
    bag = BagWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if zstd:
        bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag as writer:
        connections: dict[str, Any] = {}
        for topic, kind, log_time, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], log_time, data)
    (file,) = path.glob("*.mcap")
    return file


def write_sqlite(path: Path, messages: Iterable[Message], compression: CompressionMode = CompressionMode.NONE) -> Path:
    """A folder as `ros2 bag record` makes it by default; returns it."""
    bag = BagWriter(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    if compression is not CompressionMode.NONE:
        bag.set_compression(compression, CompressionFormat.ZSTD)
    _write(bag, messages, STORE, lambda data, _: data)
    return path


def write_ros1(path: Path, messages: Iterable[Message], lz4: bool = False) -> Path:
    """A bag of ROS 1, in chunks; each topic alternates between two senders."""
    bag = Ros1Writer(path)
    if lz4:
        bag.set_compression(Ros1Writer.CompressionFormat.LZ4)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    _write(bag, messages, store, lambda data, kind: bytes(STORE.cdr_to_ros1(data, kind)))
    return path


def _write(bag: Any, messages: Iterable[Message], store: Any, convert: Callable[[bytes, str], bytes]) -> None:
    with bag as writer:
        connections: dict[tuple[str, int], Any] = {}
        for count, (topic, kind, log_time, data) in enumerate(messages):
            sender = {"callerid": f"/node{count % 2}"} if isinstance(bag, Ros1Writer) else {}
            key = (topic, count % 2 if sender else 0)
            if key not in connections:
                connections[key] = writer.add_connection(topic, kind, typestore=store, **sender)
            writer.write(connections[key], log_time, convert(data, kind))


def write_file(path: Path, messages: Iterable[Message], **options: Any) -> Path:
    """The same by the library mcap, whose options say how it is packed. Its schemas are rubbish: a reader must not follow them."""
    with open(path, "wb") as file:
        writer = Writer(file, **{"chunk_size": 50_000, "compression": CompressionType.LZ4, **options})
        writer.start("ros2", "test")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, kind, log_time, data in messages:
            if kind not in schemas:
                schemas[kind] = writer.register_schema(kind, "ros2msg", b"uint8[4000000000] x\nimport os")
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()
    return path


@dataclass
class Wall:
    """A slanted wall n·x = d (metres, colour camera) seen by a colour camera and a smaller depth camera beside it, with stripes to see."""

    size: tuple[int, int] = (64, 48)
    K: np.ndarray = field(default_factory=lambda: np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]))
    depth_size: tuple[int, int] = (48, 36)
    depth_K: np.ndarray = field(default_factory=lambda: np.array([[40.0, 0, 23.0], [0, 40.0, 18.0], [0, 0, 1]]))
    n: np.ndarray = field(default_factory=lambda: np.array([0.2, 0.1, 0.97]))
    d: float = 2.0
    T_color_depth: np.ndarray = field(default_factory=lambda: np.eye(4))

    def depth_in_color(self) -> np.ndarray:
        """(h, w) metres."""
        return self.d / (_rays(self.size, self.K) @ self.n)

    def depth(self) -> np.ndarray:
        """(h, w) metres of the depth camera: n·(R z ray + t) = d."""
        R, t = self.T_color_depth[:3, :3], self.T_color_depth[:3, 3]
        return (self.d - self.n @ t) / (_rays(self.depth_size, self.depth_K) @ (R.T @ self.n))

    def color(self, channels: int = 3) -> np.ndarray:
        """(h, w, channels) 0..255, each channel another pattern."""
        y, x = np.mgrid[: self.size[1], : self.size[0]]
        planes = [(x * 4) % 256, (y * 5) % 256, (x + y) * 2 % 256, np.full_like(x, 255)]
        return np.stack(planes[:channels], axis=-1).astype(np.uint8)


def _rays(size: tuple[int, int], K: np.ndarray) -> np.ndarray:
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x, float)], axis=-1)
