"""The surface of a run as PLY, OBJ, binary glTF and a list of its planes.

All are in metres and upright: `upright` turns the world so that `Surface.up` is +z (or +y) and the first camera looks along +y (or -z)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F64, PLANE_KINDS, Surface
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.run.ply import triangle_planes, write_ply
from trihedron.tools.export import Format
from trihedron.tools.gltf import glb

CAMERA_UP, CAMERA_AHEAD = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])  # of the first frame, which is the world


def surface_of(recording: Recording) -> Surface:
    """The recorded surface. Raises DataError when the run has none."""
    found = None
    if "surface" in recording.topics:
        found = next((value for value in recording.values("surface") if isinstance(value, Surface)), None)
    if found is None:
        raise DataError(str(recording.path), "holds no surface", "run with outputs=[trajectory,surface]")
    return found


def upright(up: F64, axis: str = "z") -> F64:
    """(3, 3) `R_file_world` for the up direction (3,) of the world, NaN = that of the first camera: up becomes `axis`."""
    up = up / np.linalg.norm(up) if np.isfinite(up).all() else CAMERA_UP
    ahead = CAMERA_AHEAD - (CAMERA_AHEAD @ up) * up
    if np.linalg.norm(ahead) < 0.1:  # the first camera looked straight up or down
        ahead = CAMERA_UP - (CAMERA_UP @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    return np.stack([right, ahead, up]) if axis == "z" else np.stack([right, up, -ahead])


def _summary(surface: Surface) -> str:
    if len(surface.triangles) == 0:
        return "empty: the run has no surface to speak of"
    guessed = "" if np.isfinite(surface.up).all() else "; no Manhattan frame says what is up, so the first camera's up was taken"
    return f"{len(surface.triangles)} triangles, {len(surface.plane_ids)} planes{guessed}"


def write_mesh(recording: Recording, path: Path) -> str:
    """PLY, binary: vertices with RGB, faces with the id of their plane."""
    surface = surface_of(recording)
    vertices = (surface.vertices_m @ upright(surface.up).T).astype(np.float32)
    write_ply(path, vertices, surface.colors, surface.triangles, triangle_planes(surface), "metres; z up; x right and y ahead of the first camera")
    return _summary(surface)


def write_obj(recording: Recording, path: Path) -> str:
    """OBJ: vertices with RGB (0..1), one group for each plane, one for the rest."""
    surface = surface_of(recording)
    lines = ["# metres; z up; x right and y ahead of the first camera"]
    vertices = surface.vertices_m @ upright(surface.up).T
    lines += [f"v {x:.5f} {y:.5f} {z:.5f} {r:.3f} {g:.3f} {b:.3f}" for (x, y, z), (r, g, b) in zip(vertices, surface.colors / 255.0)]
    for plane in range(-1, len(surface.plane_ids)):
        rows = surface.triangles[surface.instances == plane] + 1
        if len(rows):
            lines.append(f"g {_name(surface, plane)}")
            lines += [f"f {a} {b} {c}" for a, b, c in rows]
    path.write_text("\n".join(lines) + "\n")
    return _summary(surface)


def write_gltf(recording: Recording, path: Path) -> str:
    """Binary glTF 2.0: a node for each plane, with its facts as extras and its picture from one atlas, and one with RGB vertices for the rest."""
    surface = surface_of(recording)
    R = upright(surface.up, "y")
    vertices = (surface.vertices_m @ R.T).astype(np.float32)
    h, w = surface.atlas.shape[:2]
    parts = []
    for plane in range(-1, len(surface.plane_ids)):
        mine = surface.instances == plane
        used, corner = np.unique(surface.triangles[mine], return_inverse=True)
        if not mine.any():
            continue
        part: dict[str, Any] = {"name": _name(surface, plane), "positions": vertices[used], "indices": corner.reshape(-1).astype(np.uint32)}
        if plane >= 0:
            texels = np.empty((len(used), 2), np.float32)
            texels[corner.reshape(-1)] = surface.texels[mine].reshape(-1, 2)
            part["texels"] = ((texels + 0.5) / np.array([w, h])).astype(np.float32)
            part["normals"] = np.tile(R @ surface.coefficients[plane, :3], (len(used), 1)).astype(np.float32)
            part["extras"] = _facts(surface, plane, R)
        else:
            part["colors"] = surface.colors[used]
        parts.append(part)
    path.write_bytes(glb(parts, surface.atlas))
    return _summary(surface)


def write_planes(recording: Recording, path: Path) -> str:
    """JSON: each plane with id, kind, normal, distance, area, colour and its boundary loops, anticlockwise about the normal, holes the other way."""
    surface = surface_of(recording)
    R = upright(surface.up)
    vertices = surface.vertices_m @ R.T
    planes = []
    for plane in range(len(surface.plane_ids)):
        loops = [vertices[surface.loop_vertices[a:b]] for p, a, b in surface.loops if p == plane]
        planes.append({**_facts(surface, plane, R), "boundary": [np.round(loop, 5).tolist() for loop in loops]})
    content = {"unit": "m", "up": [0, 0, 1], "R_file_world": R.tolist(), "planes": planes}
    path.write_text(json.dumps(content, indent=1) + "\n")
    return _summary(surface)


def _name(surface: Surface, plane: int) -> str:
    return f"{PLANE_KINDS[surface.kinds[plane]]}_{surface.plane_ids[plane]}" if plane >= 0 else "rest"


def _facts(surface: Surface, plane: int, R: F64) -> dict[str, Any]:
    """What is known of a plane; normal·x + d = 0 in the file's axes."""
    return {
        "id": int(surface.plane_ids[plane]),
        "kind": PLANE_KINDS[surface.kinds[plane]],
        "normal": np.round(R @ surface.coefficients[plane, :3], 6).tolist(),
        "d": round(float(surface.coefficients[plane, 3]), 6),
        "area_m2": round(float(surface.areas_m2[plane]), 4),
        "color": surface.plane_colors[plane].tolist(),
    }


FORMATS = (
    Format("ply", "surface_upright.ply", write_mesh),
    Format("obj", "surface.obj", write_obj),
    Format("gltf", "surface.glb", write_gltf),
    Format("planes.json", "planes.json", write_planes),
)
