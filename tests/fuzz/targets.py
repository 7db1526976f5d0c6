"""The readers that the fuzzer knows: each takes the path of a file, and may raise what is in DECLARED."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison.mesh_files import read_mesh
from trihedron.datasets.readers import foxglove_messages
from trihedron.datasets.readers.association import read_file_list
from trihedron.datasets.readers.cameras import read_camera_file
from trihedron.datasets.readers.icl_nuim import IclNuim
from trihedron.datasets.readers.images import decode_image, read_color, read_depth
from trihedron.datasets.readers.matrices import read_matrix, trajectory_of
from trihedron.datasets.readers.mcap import McapDataset
from trihedron.datasets.readers.picture_headers import UnreadableImage
from trihedron.datasets.readers.pixels import color_of, depth_of, kind_of
from trihedron.datasets.readers.replica import read_parameters
from trihedron.datasets.readers.robot_streams import ROS
from trihedron.datasets.readers.robot_values import Picture, UnreadableMessage
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.recorded_config import recorded_config
from trihedron.pipeline.record.codec import METADATA, Decoder
from trihedron.pipeline.record.mcap_file import McapFile
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.rescue import recover
from trihedron.pipeline.record.trajectories import read_trajectory
from trihedron.pipeline.run.map_file import load_map

DECLARED = (TrihedronError, UnreadableImage, UnreadableMessage)
BESIDE = {"associations.txt", "mesh.ply", "mesh.obj", "recovered.mcap"}  # what a target may write beside its input


def lists(path: Path) -> int:
    """rgb.txt and depth.txt of the TUM layout."""
    return len(read_file_list(path).files)


def associations(path: Path) -> int:
    """The associations of ICL-NUIM, with a folder about them."""
    (path.parent / "associations.txt").write_bytes(path.read_bytes())
    return len(IclNuim(str(path.parent)))


def cameras(path: Path) -> int:
    """camera.yaml beside a folder of images."""
    return read_camera_file(path).camera.width


def parameters(path: Path) -> int:
    """cam_params.json of Replica."""
    return read_parameters(path).camera.width


def trajectories(path: Path) -> int:
    """Poses in TUM format."""
    return len(read_trajectory(path))


def matrices(path: Path) -> int:
    """Poses as 4 × 4 numbers."""
    return len(trajectory_of(np.array([0]), [read_matrix(path)], [str(path)]) or ())


def frames(path: Path) -> int:
    """dataset=mcap, whoever recorded it. The truth of a robot is a topic of poses, else the transforms."""
    dataset, file = McapDataset(str(path)), McapFile(path)
    read = sum(dataset(index) is not None for index in range(min(len(dataset), 3)))
    if METADATA not in file.metadata:
        told = any(channel.topic == "/pose" for channel in file.channels.values())
        dataset = McapDataset(str(path), truth_from="/pose" if told else "map")
    truth = dataset.truth()
    return 0 if truth is None or not len(truth) else read


def recording(path: Path) -> int:
    """All topics of a recording, and one frame."""
    opened = Recording(path)
    opened.overrides()
    read = 0
    for topic in sorted(opened.topics):
        try:
            read += sum(1 for _ in opened.values(topic))
        except TrihedronError:
            continue
    return min(read, len(opened.frame(2)))


def configuration(path: Path) -> int:
    """The recorded configuration of a run."""
    recorded_config(path.read_text("utf-8", "replace"), str(path))
    return 1


def saved_map(path: Path) -> int:
    """A map to go on in."""
    return len(load_map(str(path)).values)


def meshes(path: Path) -> int:
    """PLY, ASCII and binary, and OBJ."""
    data = path.read_bytes()
    mesh = path.with_name("mesh.ply" if data[:2] == b"pl" else "mesh.obj")
    mesh.write_bytes(data)
    return len(read_mesh(mesh)[1])


def damaged(path: Path) -> int:
    """trihedron recover, and what it has written."""
    recovered = path.with_name("recovered.mcap")
    recover(path, recovered)
    return len(McapFile(recovered).channels)


def pictures(path: Path) -> int:
    """PNG, JPEG, BMP, PNM and TIFF, as colour and as depth, from a file and from a message."""
    return _one_of(path, read_color, lambda file: read_depth(file, 1000.0), lambda file: decode_image(file.read_bytes()))


def message(path: Path) -> int:
    """One message: the first byte says of which type; images go on to their pixels."""
    data = path.read_bytes()
    readers: list[Callable[[bytes], Any]] = [decode for _, decode in ROS.values()]
    readers += [foxglove_messages.reader(kind, encoding) for kind in foxglove_messages.READERS for encoding in ("protobuf", "json")]
    readers += [Decoder("message").decode]
    value = readers[data[0] % len(readers)](data[1:]) if data else None
    if isinstance(value, Picture):
        return _one_of(value, kind_of, color_of, lambda picture: depth_of(picture, 1000.0))
    return value is not None


def _one_of(given: Any, *uses: Callable[[Any], Any]) -> int:
    """How many of the uses are not refused; a picture of depth is none of colours."""
    done = 0
    for use in uses:
        try:
            use(given)
            done += 1
        except DECLARED:
            continue
    return done


Reader = Callable[[Path], int]  # how much was read: 0 is nothing
TARGETS: dict[str, tuple[str, Reader, float]] = {  # name -> pattern of its seeds, reader, share of the inputs
    "lists": ("list*.txt", lists, 0.1),
    "associations": ("associations*.txt", associations, 0.03),
    "cameras": ("camera*.yaml", cameras, 0.07),
    "parameters": ("cam_params*.json", parameters, 0.05),
    "trajectories": ("trajectory*.txt", trajectories, 0.1),
    "matrices": ("matrix*.txt", matrices, 0.05),
    "meshes": ("mesh*", meshes, 0.05),
    "pictures": ("picture*", pictures, 0.15),
    "messages": ("message*", message, 0.18),
    "recordings": ("own*.mcap", recording, 0.05),
    "frames": ("own*.mcap", frames, 0.03),
    "map": ("map*.mcap", saved_map, 0.03),
    "ros": ("ros*.mcap", frames, 0.06),
    "foxglove": ("foxglove*.mcap", frames, 0.03),
    "damaged": ("own*.mcap", damaged, 0.02),
    "configurations": ("config*.yaml", configuration, 0.02),
}
IN_CONTAINER = {"recordings", "frames", "map", "ros", "foxglove"}  # their inputs are changed inside messages, too
