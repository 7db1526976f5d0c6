"""Meshes from files of any program."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F64, I32

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip


def read_mesh(path: Path) -> tuple[F64, I32]:
    """Vertices (v, 3) and triangles (t, 3) of a PLY (ASCII or binary little-endian) or OBJ file; polygons become fans. Raises DataError."""
    if not path.is_file():
        raise DataError(str(path), "there is no such file", "run with outputs=[trajectory,surface] first")
    vertices: F64 | list[list[float]]
    polygons: I32 | list[list[int]]
    try:
        if path.suffix.lower() == ".obj":
            vertices, polygons = _obj(path)
        elif path.suffix.lower() == ".ply":
            vertices, polygons = _ply(path.read_bytes())
        else:
            raise DataError(str(path), f"'{path.suffix}' is not a mesh file this program reads", "give a .ply or .obj file")
        points = np.asarray(vertices, np.float64).reshape(len(vertices), 3)
        triangles = [(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)] if isinstance(polygons, list) else polygons
        found = np.asarray(triangles, np.int32).reshape(-1, 3)
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise DataError(str(path), f"is not a mesh: {' '.join(str(error).split())}", "give a .ply or .obj file") from error
    if not np.isfinite(points).all():
        raise DataError(str(path), "has a vertex that is not finite", "the file is damaged; write it again")
    if len(found) and (found.min() < 0 or found.max() >= len(points)):
        raise DataError(str(path), "a face names a vertex that is not there", "the file is damaged; write it again")
    return points, found


def _obj(path: Path) -> tuple[list[list[float]], list[list[int]]]:
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            numbers = [int(word.split("/")[0]) for word in words[1:]]
            polygons.append([n - 1 if n > 0 else len(vertices) + n for n in numbers])
    return vertices, polygons


def _ply(data: bytes) -> tuple[F64, I32 | list[list[int]]]:
    head, _, body = data.partition(b"end_header\n")
    words = [line.split() for line in head.decode("ascii").splitlines()]
    kind = next((w[1] for w in words if w[:1] == ["format"] and len(w) > 1), "")
    elements: list[tuple[str, int, list[list[str]]]] = []
    for w in words:
        if w[:1] == ["element"]:
            elements.append((w[1], int(w[2]), []))
        elif w[:1] == ["property"]:
            elements[-1][2].append(w[1:])
    if kind == "ascii":
        return _ascii(body.decode("ascii").splitlines(), elements)
    if kind != "binary_little_endian":
        raise ValueError(f"the format {kind} is not read")
    vertices, faces, at = np.empty((0, 3)), np.empty((0, 3), np.int32), 0
    for name, count, properties in elements:
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for p in properties:
            if p[0] == "list":
                fields += [("count", PLY_TYPES[p[1]]), ("corners", PLY_TYPES[p[2]], (3,))]
            else:
                fields.append((p[1], PLY_TYPES[p[0]]))
        rows = np.frombuffer(body, np.dtype(fields), count, at)
        at += rows.nbytes
        if name == "vertex":
            vertices = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
        elif name == "face":
            if (rows["count"] != 3).any():
                raise ValueError("a face that is no triangle")
            faces = rows["corners"].astype(np.int32)
    return vertices, faces


def _ascii(lines: list[str], elements: list[tuple[str, int, list[list[str]]]]) -> tuple[F64, list[list[int]]]:
    vertices, polygons, at = np.empty((0, 3)), [], 0
    for name, count, properties in elements:
        rows = [line.split() for line in lines[at : at + count]]
        at += count
        if name == "vertex":
            column = [[p[-1] for p in properties].index(axis) for axis in "xyz"]
            vertices = np.array([[float(row[k]) for k in column] for row in rows]).reshape(-1, 3)
        elif name == "face":
            polygons = [[int(word) for word in row[1 : 1 + int(row[0])]] for row in rows]
    return vertices, polygons
