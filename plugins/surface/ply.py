"""Surfaces as PLY files: binary, metres, vertices with RGB, faces with the id of their plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.types import F32, I32, U8, Surface

AXES, COLORS = ("x", "y", "z"), ("red", "green", "blue")
VERTEX = np.dtype([*((name, "<f4") for name in AXES), *((name, "u1") for name in COLORS)])
FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,)), ("plane", "<i4")])


def write_ply(path: Path, vertices_m: F32, colors: U8, triangles: I32, planes: I32, comment: str) -> None:
    """Write vertices (v, 3), RGB (v, 3), triangles (t, 3) and for each the id of its plane (t,), -1 for none."""
    head = [
        "ply", "format binary_little_endian 1.0", f"comment {comment}",
        f"element vertex {len(vertices_m)}", *(f"property float {name}" for name in AXES), *(f"property uchar {name}" for name in COLORS),
        f"element face {len(triangles)}", "property list uchar int vertex_indices", "property int plane", "end_header", "",
    ]  # fmt: skip
    points, faces = np.empty(len(vertices_m), VERTEX), np.empty(len(triangles), FACE)
    for k in range(3):
        points[AXES[k]], points[COLORS[k]] = vertices_m[:, k], colors[:, k]
    faces["count"], faces["corners"], faces["plane"] = 3, triangles, planes
    write_file(path, "\n".join(head).encode() + points.tobytes() + faces.tobytes())


def triangle_planes(surface: Surface) -> I32:
    """Return (t,) id of the plane each triangle lies in, -1 for none."""
    ids = np.append(surface.plane_ids, np.int32(-1))
    return np.asarray(ids[surface.instances], np.int32)
