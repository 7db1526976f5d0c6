"""The seeds of the fuzzer: small good files of each kind a reader takes."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap.writer import CompressionType
from omegaconf import OmegaConf

from trihedron.datasets.readers import foxglove_messages
from trihedron.datasets.readers.robot_streams import ROS
from trihedron.pipeline.core.config import compose_run
from trihedron.pipeline.core.geometry import quaternion_from_rotation
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.record.codec import is_value_schema
from trihedron.pipeline.record.trajectories import TRUTH
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.runner import Runner
from trihedron.plugins.mapping.landmarks import empty_map
from trihedron.plugins.surface.ply import write_ply

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "datasets"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "pipeline"))
from foxglove_files import write_json, write_protobuf
from robot_files import (
    COLOR,
    DEPTH,
    SECOND,
    Message,
    Wall,
    camera_info,
    compressed,
    encoded,
    header,
    image,
    make,
    message,
    pose,
    transforms,
    write_file,
)  # fmt: skip
from toys import TOPICS, ToyDataset, toy_graph

SMALL = Wall((16, 12), np.array([[15.0, 0, 7.5], [0, 15.0, 5.5], [0, 0, 1]]), (12, 9), np.array([[10.0, 0, 5.5], [0, 10.0, 4.0], [0, 0, 1]]))
BEGIN, STEP = 1_700_000_000_000_000_000, 33_000_000
TRUE_POSES = "".join(f"{10 + k / 10:.6f} {k} 0.5 -1e-3 0 0 0.1 0.995\n" for k in range(4))


def make_seeds(folder: Path) -> None:
    """Write them all."""
    folder.mkdir(exist_ok=True)
    (folder / "list_rgb.txt").write_text("# colour\n" + "".join(f"1305031102.{k}75304 rgb/1305031102.{k}75304.png\n" for k in range(4)))
    (folder / "associations.txt").write_text("".join(f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in range(1, 4)))
    (folder / "camera_short.yaml").write_text("width: 64\nheight: 48\nfx: 60.0\nfy: 60.0\ncx: 31.5\ncy: 23.5\ndepth_scale: 5000\n")
    more = "fps: 20\ndepth_noise: {b: 0.005, floor_m: 0.002}\ndepth_offset: 0.01\ndistortion: {k1: 0.1, k2: -0.2, p1: 0, p2: 1e-3, k3: 0}\n"
    more += "depth_radial: -0.01\ndepth_camera: {fx: 61, fy: 61, cx: 32, cy: 24, translation_m: [0.025, 0, 0], rotation_deg: [0, 0.5, 0]}\n"
    more += "readout_s: 0.03\ndepth_readout_s: -0.01\nsigmas: {focal: 0.001}\n"
    (folder / "camera_long.yaml").write_text((folder / "camera_short.yaml").read_text() + more)
    camera = {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    (folder / "trajectory.txt").write_text(f"# stamp tx ty tz qx qy qz qw\n{TRUE_POSES}")
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(compose_run(["load_map=map.mcap"]), resolve=True))
    (folder / "matrix.txt").write_text("\n".join(" ".join(f"{x:.6f}" for x in row) for row in exp_se3(np.arange(6) / 10)))
    _pictures_and_meshes(folder)
    _robots(folder)
    _foxglove(folder)
    _own(folder)
    _messages(folder)


def _pictures_and_meshes(folder: Path) -> None:
    color, depth = SMALL.color(), np.rint(SMALL.depth_in_color() * 1000).astype(np.uint16)
    for extension in (".png", ".jpg", ".bmp", ".ppm", ".tif"):
        (folder / f"picture_color{extension}").write_bytes(encoded(extension, color))
    for extension in (".png", ".pgm", ".tif"):
        (folder / f"picture_depth{extension}").write_bytes(encoded(extension, depth))
    (folder / "picture_tiled.tif").write_bytes(_tiled(np.pad(depth, ((0, 4), (0, 0)))))
    corners, triangles = np.eye(4, 3, dtype=np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    write_ply(folder / "mesh_binary.ply", corners, np.zeros((4, 3), np.uint8), triangles, np.array([0, -1], np.int32), "seed")
    vertex = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head = f"ply\nformat ascii 1.0\n{vertex}element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    rows = ["{:g} {:g} {:g}".format(*corner) for corner in corners.tolist()]
    faces = [" ".join(map(str, row)) for row in triangles.tolist()]
    (folder / "mesh_ascii.ply").write_text(head + "\n".join([*rows, *(f"3 {face}" for face in faces)]) + "\n")
    text = [*(f"v {row}" for row in rows), "f 1/1 2/2 3/3", "f -4 -2 -1"]
    (folder / "mesh.obj").write_text("\n".join(text) + "\n")


def _tiled(depth: np.ndarray) -> bytes:
    """A TIFF of one tile of 16 × 16 pixels of 16 bits."""
    tags = [(256, 16), (257, 16), (258, 16), (259, 1), (262, 1), (277, 1), (322, 16), (323, 16), (324, 8), (325, 512)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return struct.pack("<2sHI", b"II", 42, 520) + depth.astype("<u2").tobytes() + struct.pack("<H", len(tags)) + entries + bytes(4)


def _robots(folder: Path) -> None:
    turned = exp_se3(np.array([0.03, 0.0, 0.0, 0.01, 0.0, 0.0]))
    depth = SMALL.depth().astype(np.float32)
    packed = bytes(12) + encoded(".png", np.rint(depth * 1000).astype(np.uint16))
    raw: list[Message] = [transforms("/tf_static", [(BEGIN, "base", COLOR, turned), (BEGIN, "base", DEPTH, np.eye(4))])]
    small = list(raw)
    for k in range(3):
        stamp = BEGIN + k * STEP
        infos = [camera_info("/c/camera_info", stamp, COLOR, SMALL.size, SMALL.K, [0.1, 0, 0, 0, 0])]
        infos.append(camera_info("/d/camera_info", stamp, DEPTH, SMALL.depth_size, SMALL.depth_K))
        moved = transforms("/tf", [(stamp, "map", "base", exp_se3(np.array([0.1 * k, 0, 0, 0, 0, 0])))])
        raw += [*infos, *_said(stamp), image("/c/image_raw", stamp, COLOR, "bgr8", SMALL.color())]
        raw += [image("/d/image_raw", stamp, DEPTH, "32FC1", depth)]
        small += [*infos, moved, compressed("/c/image_raw/compressed", stamp, COLOR, "bgr8; jpeg compressed bgr8", encoded(".jpg", SMALL.color()))]
        small += [compressed("/d/image_raw/compressedDepth", stamp, DEPTH, "16UC1; compressedDepth png", packed)]
    write_file(folder / "ros_raw.mcap", raw, compression=CompressionType.NONE, enable_crcs=False, chunk_size=4_000)
    write_file(folder / "ros_compressed.mcap", small, compression=CompressionType.ZSTD, chunk_size=4_000)
    write_file(folder / "ros_loose.mcap", small, use_chunking=False)


def _said(stamp_ns: int) -> list[Message]:
    """A pose in each type of message that says one."""
    head, at = header(stamp_ns, "map"), pose(exp_se3(np.array([0.1, 0.2, 0, 0, 0, 0.3])))
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    covariance = make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.zeros(36))
    still = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    twist = make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36))
    moved = make("geometry_msgs/msg/Transform", translation=zero, rotation=at.orientation)
    kinds = {
        "/pose": ("geometry_msgs/msg/PoseStamped", {"pose": at}),
        "/pose_covariance": ("geometry_msgs/msg/PoseWithCovarianceStamped", {"pose": covariance}),
        "/odom": ("nav_msgs/msg/Odometry", {"child_frame_id": "base", "pose": covariance, "twist": twist}),
        "/body": ("geometry_msgs/msg/TransformStamped", {"child_frame_id": "base", "transform": moved}),
    }
    return [message(topic, kind, stamp_ns, make(kind, header=head, **fields)) for topic, (kind, fields) in kinds.items()]


def _foxglove(folder: Path) -> None:
    """Protobuf with depth in the colour camera; protobuf with a depth camera and a lens of its own; JSON with poses. Each with the truth."""
    plain, turned = np.eye(4), exp_se3(np.array([0.03, 0.0, 0.0, 0.01, 0.0, 0.0]))
    one, own, told = [], [], []
    for k in range(3):
        stamp, moved = BEGIN + k * STEP, exp_se3(np.array([0.1 * k, 0, 0, 0, 0, 0]))
        registered = _raw_image(stamp, COLOR, "16UC1", np.rint(SMALL.depth_in_color() * 1000).astype(np.uint16))
        picture = CompressedImage(timestamp=_stamp(stamp), frame_id=COLOR, data=encoded(".png", SMALL.color()), format="png")
        info = _calibration(stamp, COLOR, SMALL.size, SMALL.K)
        one += [("/info", info), ("/color", picture), ("/depth", registered), ("/tf", _transform(stamp, "map", COLOR, moved))]
        links = FrameTransforms(transforms=[_transform(stamp, "map", "base", moved), _transform(stamp, "base", COLOR, turned)])
        own += [("/c/info", _calibration(stamp, COLOR, SMALL.size, SMALL.K, [0.1, 0, 0, 0, 0])), ("/tf", links)]
        own += [("/c/image", _raw_image(stamp, COLOR, "rgb8", SMALL.color())), ("/tf_static", _transform(stamp, "base", DEPTH, plain))]
        depth = _raw_image(stamp, DEPTH, "32FC1", SMALL.depth().astype(np.float32))
        own += [("/d/info", _calibration(stamp, DEPTH, SMALL.depth_size, SMALL.depth_K)), ("/d/image", depth)]
        pose = PoseInFrame(timestamp=_stamp(stamp), frame_id="map", pose=_pose(moved))
        told += [("/info", info), ("/color", picture), ("/depth", registered), ("/pose", pose)]
    write_protobuf(folder / "foxglove_registered.mcap", _timed(one), compression=CompressionType.NONE, enable_crcs=False)
    write_protobuf(folder / "foxglove_own_depth.mcap", _timed(own), compression=CompressionType.NONE, enable_crcs=False, chunk_size=4_000)
    write_json(folder / "foxglove_json.mcap", _timed(told), compression=CompressionType.LZ4)


def _timed(messages: list[tuple[str, Any]]) -> list[tuple[str, int, Any]]:
    return [(topic, BEGIN + k * 1_000_000, value) for k, (topic, value) in enumerate(messages)]


def _stamp(stamp_ns: int) -> Timestamp:
    return Timestamp(seconds=stamp_ns // SECOND, nanos=stamp_ns % SECOND)


def _raw_image(stamp_ns: int, frame_id: str, encoding: str, pixels: np.ndarray) -> RawImage:
    fields = {"width": pixels.shape[1], "height": pixels.shape[0], "step": pixels[0].nbytes, "data": pixels.tobytes()}
    return RawImage(timestamp=_stamp(stamp_ns), frame_id=frame_id, encoding=encoding, **fields)


def _calibration(stamp_ns: int, frame_id: str, size: tuple[int, int], K: np.ndarray, D: Sequence[float] = ()) -> CameraCalibration:
    fields = {"width": size[0], "height": size[1], "K": K.reshape(-1), "P": np.column_stack([K, np.zeros(3)]).reshape(-1), "D": D}
    return CameraCalibration(timestamp=_stamp(stamp_ns), frame_id=frame_id, distortion_model="plumb_bob", R=np.eye(3).reshape(-1), **fields)


def _pose(T: np.ndarray) -> Pose:
    x, y, z, w = quaternion_from_rotation(T[:3, :3]).tolist()
    return Pose(position=Vector3(x=T[0, 3], y=T[1, 3], z=T[2, 3]), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _transform(stamp_ns: int, parent: str, child: str, T: np.ndarray) -> FrameTransform:
    at = _pose(T)
    return FrameTransform(
        timestamp=_stamp(stamp_ns), parent_frame_id=parent, child_frame_id=child, translation=at.position, rotation=at.orientation
    )  # fmt: skip


def _own(folder: Path) -> None:
    runner = Runner(toy_graph(dataset=ToyDataset(5)))
    writer = RecordingWriter(folder / "own.mcap", {"overrides": "[]"})
    writer.attach(TRUTH, TRUE_POSES)
    for _ in runner.steps(writer, TOPICS | {"dataset"}, embed_frames=True):
        pass
    writer.close()
    writer = RecordingWriter(folder / "map.mcap", {"kind": "map", "map_version": "1", "frame": "4", "source": "{}"})
    writer.write("map", empty_map(4, 4_000, 32, 32, 8))
    writer.write("pose", runner.result.poses[-1])
    writer.close()


def _messages(folder: Path) -> None:
    """One message of each topic, behind a byte that says of which type."""
    kinds = [*ROS, *(f"{kind} {encoding}" for kind in foxglove_messages.READERS for encoding in ("protobuf", "json")), "values"]
    for name in ("ros_raw", "ros_compressed", "foxglove_registered", "foxglove_own_depth", "foxglove_json", "own"):
        seen: set[str] = set()
        with open(folder / f"{name}.mcap", "rb") as file:
            for schema, channel, sent in make_reader(file).iter_messages():
                assert schema is not None
                kind = (
                    f"{schema.name} {channel.message_encoding}"
                    if schema.name in foxglove_messages.READERS
                    else "values"
                    if is_value_schema(schema.name)
                    else schema.name
                )
                if kind in kinds and channel.topic not in seen:
                    seen.add(channel.topic)
                    (folder / f"message_{name}{channel.topic.replace('/', '_')}").write_bytes(bytes([kinds.index(kind)]) + sent.data)
