"""The readers that the fuzzer knows: each takes the path of a file, and may raise what is in DECLARED."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.datasets import foxglove_messages
from trihedron.datasets.cameras import read_camera_file
from trihedron.datasets.icl_nuim import IclNuim
from trihedron.datasets.images import decode_image, read_color, read_depth
from trihedron.datasets.lists import read_file_list
from trihedron.datasets.matrices import read_matrix, trajectory_of
from trihedron.datasets.mcap import McapDataset
from trihedron.datasets.picture_headers import UnreadableImage
from trihedron.datasets.pixels import color_of, depth_of, kind_of
from trihedron.datasets.replica import read_parameters
from trihedron.datasets.robot_streams import ROS
from trihedron.datasets.robot_values import Picture, UnreadableMessage
from trihedron.datasets.trajectories import read_trajectory
from trihedron.pipeline.codec import Decoder
from trihedron.pipeline.errors import TrihedronError
from trihedron.pipeline.mcap_file import McapFile
from trihedron.pipeline.recording import METADATA, Recording
from trihedron.pipeline.state import load_map
from trihedron.tools.mesh_files import read_mesh
from trihedron.tools.recover import recover

DECLARED = (TrihedronError, UnreadableImage, UnreadableMessage)
BESIDE = {"associations.txt", "mesh.ply", "mesh.obj", "recovered.mcap"}  # what a target may write beside its input


def lists(path: Path) -> None:
    """rgb.txt and depth.txt of the TUM layout."""
    read_file_list(path)


def associations(path: Path) -> None:
    """The associations of ICL-NUIM, with a folder about them."""
    (path.parent / "associations.txt").write_bytes(path.read_bytes())
    len(IclNuim(str(path.parent)))


def matrices(path: Path) -> None:
    """Poses as 4 × 4 numbers."""
    trajectory_of(np.array([0]), [read_matrix(path)], [str(path)])


def frames(path: Path) -> None:
    """dataset=mcap, whoever recorded it."""
    dataset = McapDataset(str(path))
    for index in range(min(len(dataset), 3)):
        dataset(index)
    dataset.truth()
    if METADATA not in McapFile(path).metadata:
        McapDataset(str(path), truth_from="map").truth()


def recording(path: Path) -> None:
    """All topics of a recording, and one frame."""
    opened = Recording(path)
    opened.overrides()
    for topic in sorted(opened.topics):
        for _ in opened.values(topic):
            pass
    opened.frame(2)


def meshes(path: Path) -> None:
    """PLY, ASCII and binary, and OBJ."""
    data = path.read_bytes()
    mesh = path.with_name("mesh.ply" if data[:2] == b"pl" else "mesh.obj")
    mesh.write_bytes(data)
    read_mesh(mesh)


def damaged(path: Path) -> None:
    """trihedron recover, and what it has written."""
    recovered = path.with_name("recovered.mcap")
    recover(path, recovered)
    McapFile(recovered)


def pictures(path: Path) -> None:
    """PNG, JPEG, BMP, PNM and TIFF, as colour and as depth, from a file and from a message."""
    for read in (read_color, lambda file: read_depth(file, 1000.0), lambda file: decode_image(file.read_bytes())):
        try:
            read(path)
        except DECLARED:
            continue


def message(path: Path) -> None:
    """One message: the first byte says of which type; images go on to their pixels."""
    data = path.read_bytes()
    readers: list[Callable[[bytes], Any]] = [decode for _, decode in ROS.values()]
    readers += [foxglove_messages.reader(kind, encoding) for kind in foxglove_messages.READERS for encoding in ("protobuf", "json")]
    readers += [Decoder("message").decode]
    value = readers[data[0] % len(readers)](data[1:]) if data else None
    if isinstance(value, Picture):
        for use in (kind_of, color_of, lambda picture: depth_of(picture, 1000.0)):
            try:
                use(value)
            except DECLARED:
                continue


TARGETS: dict[str, tuple[str, Callable[[Path], Any], float]] = {  # name -> pattern of its seeds, reader, share of the inputs
    "lists": ("list*.txt", lists, 0.1),
    "associations": ("associations*.txt", associations, 0.03),
    "cameras": ("camera*.yaml", read_camera_file, 0.07),
    "parameters": ("cam_params*.json", read_parameters, 0.05),
    "trajectories": ("trajectory*.txt", read_trajectory, 0.1),
    "matrices": ("matrix*.txt", matrices, 0.05),
    "meshes": ("mesh*", meshes, 0.05),
    "pictures": ("picture*", pictures, 0.15),
    "messages": ("message*", message, 0.18),
    "recordings": ("own*.mcap", recording, 0.05),
    "frames": ("own*.mcap", frames, 0.03),
    "map": ("map*.mcap", load_map, 0.03),
    "ros": ("ros*.mcap", frames, 0.06),
    "foxglove": ("foxglove*.mcap", frames, 0.03),
    "damaged": ("own*.mcap", damaged, 0.02),
}
IN_CONTAINER = {"recordings", "frames", "map", "ros", "foxglove"}  # their inputs are changed inside messages, too
