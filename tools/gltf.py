"""Binary glTF 2.0 files (.glb): one JSON chunk, one chunk of bytes."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import U8

MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT, UNSIGNED_INT, UNSIGNED_BYTE = 5126, 5125, 5121
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
TEXTURED, PAINTED = 0, 1  # materials


def glb(parts: Sequence[dict[str, Any]], atlas: U8) -> bytes:
    """A scene of meshes. A part has `name`, `positions` (n, 3), `indices` (3 t,), and `texels` (n, 2, 0..1) in the atlas (h, w, 3) with `normals`
    (n, 3), or `colors` (n, 3) RGB; `extras` are attached to its node."""
    buffer = _Buffer()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "trihedron"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(parts)))}],
        "nodes": [],
        "meshes": [],
        "materials": [_material("planes", bool(atlas.size)), _material("rest", False)],
    }
    for number, part in enumerate(parts):
        document["nodes"].append({"mesh": number, "name": part["name"], **({"extras": part["extras"]} if "extras" in part else {})})
        document["meshes"].append({"name": part["name"], "primitives": [_primitive(part, buffer)]})
    if atlas.size:
        view = buffer.add(bytes(cv2.imencode(".png", atlas[..., ::-1])[1]))
        document |= {"images": [{"bufferView": view, "mimeType": "image/png"}], "textures": [{"source": 0, "sampler": 0}]}
        document["samplers"] = [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}]  # linear, clamped
    document |= {"accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": len(buffer.data)}]}
    document = {key: value for key, value in document.items() if value != [] and (key != "buffers" or buffer.data)}
    text = json.dumps(document).encode()
    chunks = _chunk(JSON_CHUNK, text, b" ") + (_chunk(BINARY_CHUNK, bytes(buffer.data), b"\0") if buffer.data else b"")
    return struct.pack("<III", MAGIC, VERSION, 12 + len(chunks)) + chunks


def _material(name: str, textured: bool) -> dict[str, Any]:
    look: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if textured:
        look["baseColorTexture"] = {"index": 0}
    return {"name": name, "pbrMetallicRoughness": look, "doubleSided": True}


def _primitive(part: dict[str, Any], buffer: _Buffer) -> dict[str, Any]:
    positions = part["positions"]
    extent = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {"POSITION": buffer.array(positions, FLOAT, "VEC3", ARRAY_BUFFER, **extent)}
    if "texels" in part:
        attributes["NORMAL"] = buffer.array(part["normals"], FLOAT, "VEC3", ARRAY_BUFFER)
        attributes["TEXCOORD_0"] = buffer.array(part["texels"], FLOAT, "VEC2", ARRAY_BUFFER)
    else:
        rgba = np.concatenate([part["colors"], np.full((len(positions), 1), 255, np.uint8)], axis=1)  # rows of four bytes, as the standard asks
        attributes["COLOR_0"] = buffer.array(rgba, UNSIGNED_BYTE, "VEC4", ARRAY_BUFFER, normalized=True)
    indices = buffer.array(part["indices"], UNSIGNED_INT, "SCALAR", ELEMENT_ARRAY_BUFFER)
    return {"attributes": attributes, "indices": indices, "material": TEXTURED if "texels" in part else PAINTED}


class _Buffer:
    """The bytes of a file and what says where they are."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, data: bytes, **more: Any) -> int:
        """A view of more bytes, at a multiple of four."""
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.views) - 1

    def array(self, content: NDArray[Any], component: int, kind: str, target: int, **more: Any) -> int:
        """An accessor of an array's rows."""
        view = self.add(np.ascontiguousarray(content).tobytes(), target=target)
        self.accessors.append({"bufferView": view, "componentType": component, "count": len(content), "type": kind, **more})
        return len(self.accessors) - 1


def _chunk(kind: int, data: bytes, filler: bytes) -> bytes:
    data += filler * (-len(data) % 4)
    return struct.pack("<II", len(data), kind) + data
