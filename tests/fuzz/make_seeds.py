"""The seeds of the fuzzer: small good files of each kind a reader takes."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer as ProtobufWriter

from trihedron.datasets import foxglove_messages
from trihedron.datasets.robot_streams import ROS
from trihedron.datasets.trajectories import TRUTH
from trihedron.pipeline.geometry import exp_se3
from trihedron.pipeline.ply import write_ply
from trihedron.pipeline.recording import RecordingWriter
from trihedron.pipeline.runner import Runner
from trihedron.plugins.numerics.maps.landmarks import empty_map

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "datasets"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "pipeline"))
from robot_files import COLOR, DEPTH, Message, Wall, camera_info, compressed, encoded, image, transforms, write_file
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
    more = "fps: 20\ndepth_noise: exact\ndepth_offset: 0.01\ndistortion: {k1: 0.1, k2: -0.2, p1: 0, p2: 1e-3, k3: 0}\n"
    (folder / "camera_long.yaml").write_text((folder / "camera_short.yaml").read_text() + more)
    camera = {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    (folder / "trajectory.txt").write_text(f"# stamp tx ty tz qx qy qz qw\n{TRUE_POSES}")
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
        raw += [*infos, moved, image("/c/image_raw", stamp, COLOR, "bgr8", SMALL.color()), image("/d/image_raw", stamp, DEPTH, "32FC1", depth)]
        small += [*infos, moved, compressed("/c/image_raw/compressed", stamp, COLOR, "bgr8; jpeg compressed bgr8", encoded(".jpg", SMALL.color()))]
        small += [compressed("/d/image_raw/compressedDepth", stamp, DEPTH, "16UC1; compressedDepth png", packed)]
    write_file(folder / "ros_raw.mcap", raw, compression=CompressionType.NONE, enable_crcs=False, chunk_size=4_000)
    write_file(folder / "ros_compressed.mcap", small, compression=CompressionType.ZSTD, chunk_size=4_000)
    write_file(folder / "ros_loose.mcap", small, use_chunking=False)


def _foxglove(folder: Path) -> None:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
    from google.protobuf.timestamp_pb2 import Timestamp

    depth, K = np.rint(SMALL.depth_in_color() * 1000).astype(np.uint16), SMALL.K.reshape(-1)
    with open(folder / "foxglove.mcap", "wb") as file, ProtobufWriter(file, compression=CompressionType.NONE, enable_crcs=False) as writer:
        for k in range(3):
            stamp = Timestamp(seconds=100, nanos=k * STEP)
            picture = CompressedImage(timestamp=stamp, frame_id="c", data=encoded(".png", SMALL.color()), format="png")
            raw = RawImage(timestamp=stamp, frame_id="c", width=16, height=12, encoding="16UC1", step=32, data=depth.tobytes())
            writer.write_message("/info", CameraCalibration(timestamp=stamp, frame_id="c", width=16, height=12, K=K, P=np.zeros(12)), k, k)
            writer.write_message("/color", picture, k, k)
            writer.write_message("/depth", raw, k, k)


def _own(folder: Path) -> None:
    runner = Runner(toy_graph(dataset=ToyDataset(5)))
    writer = RecordingWriter(folder / "own.mcap", {"overrides": "[]"})
    writer.attach(TRUTH, TRUE_POSES)
    for _ in runner.steps(writer, TOPICS | {"dataset"}, embed_frames=True):
        pass
    writer.close()
    writer = RecordingWriter(folder / "map.mcap", {"kind": "map", "map_version": "1", "frame": "4", "source": "{}"})
    writer.write("map", empty_map(4, 4_000, 32, 32, 8))
    for pose in runner.result.poses[-1:]:
        writer.write("pose", pose)
    writer.close()


def _messages(folder: Path) -> None:
    """One message of each type, behind a byte that says which."""
    kinds = [*ROS, *(name for kind in foxglove_messages.READERS for name in (kind, f"{kind} json")), "trihedron.Value"]
    for name in ("ros_raw", "ros_compressed", "foxglove", "own"):
        seen: set[str] = set()
        with open(folder / f"{name}.mcap", "rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                assert schema is not None
                if schema.name in kinds and channel.topic not in seen:
                    seen.add(channel.topic)
                    (folder / f"message_{name}{channel.topic.replace('/', '_')}").write_bytes(bytes([kinds.index(schema.name)]) + message.data)
    stamp = {"sec": 1, "nsec": 2}
    link = {
        "timestamp": stamp,
        "parent_frame_id": "a",
        "child_frame_id": "b",
        "translation": {"x": 0, "y": 0, "z": 1},
        "rotation": {"x": 0, "y": 0, "z": 0, "w": 1},
    }
    raw = {"timestamp": stamp, "frame_id": "a", "width": 1, "height": 1, "encoding": "mono8", "step": 1, "data": "AA=="}
    for kind, content in (("foxglove.FrameTransform json", link), ("foxglove.RawImage json", raw)):
        (folder / f"message_{kind.split('.')[1].split()[0]}_json").write_bytes(bytes([kinds.index(kind)]) + json.dumps(content).encode())
