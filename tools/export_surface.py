"""The surface of a run as PLY, OBJ, binary glTF and a list of its planes.

All are in metres and upright: `upright` turns the world so that `Surface.up` is +z (or +y) and the first camera looks along +y (or -z)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.geometry import upright
from trihedron.pipeline.core.types import F64, PLANE_KINDS, Surface
from trihedron.pipeline.record.reader import Recording
from trihedron.plugins.surface.ply import triangle_planes, write_ply
from trihedron.tools.export import Format

if TYPE_CHECKING:
    import trimesh

LOOK: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0, "doubleSided": True}
UNLIT = "KHR_materials_unlit"  # the colours have the light of the place in them


def surface_of(recording: Recording) -> Surface:
    """The recorded surface. Raises DataError when the run has none."""
    found = None
    if "surface" in recording.topics:
        found = next((value for value in recording.values("surface") if isinstance(value, Surface)), None)
    if found is None:
        raise DataError(str(recording.path), "holds no surface", "run with 'outputs=[trajectory,surface]'")
    return found


def _summary(surface: Surface) -> str:
    if len(surface.triangles) == 0:
        return "empty: the run has no surface to speak of"
    guessed = "" if np.isfinite(surface.up).all() else "; no Manhattan frame determines the vertical, so the first camera's up was taken"
    return f"{len(surface.triangles)} triangles, {len(surface.plane_ids)} planes{guessed}"


def write_mesh(recording: Recording, path: Path) -> str:
    """PLY, binary: vertices with RGB, faces with the id of their plane."""
    surface = surface_of(recording)
    vertices = (surface.vertices_m @ upright(surface.up).T).astype(np.float32)
    write_ply(path, vertices, surface.colors, surface.triangles, triangle_planes(surface), "metres; z up; x right and y ahead of the first camera")
    return _summary(surface)


def write_obj(recording: Recording, path: Path) -> str:
    """OBJ: vertices with RGB (0..1), one object for each plane, one for the rest."""
    surface = surface_of(recording)
    scene = _scene(surface, upright(surface.up), textured=False)
    header = "metres; z up; x right and y ahead of the first camera"
    write_file(path, scene.export(file_type="obj", header=header, digits=5, include_normals=False) if scene.geometry else f"# {header}\n")
    return _summary(surface)


def write_gltf(recording: Recording, path: Path) -> str:
    """Binary glTF 2.0: a node for each plane, with its facts as extras and its picture from one atlas, and one with RGB vertices for the rest."""
    from trimesh.exchange.gltf import export_glb

    surface = surface_of(recording)
    scene = _scene(surface, upright(surface.up, "y"), textured=True)
    write_file(path, export_glb(scene, tree_postprocessor=_finish_gltf))
    return _summary(surface)


def _scene(surface: Surface, R: F64, textured: bool) -> trimesh.Scene:
    """A mesh for each plane and one for the rest, in the file's axes."""
    import trimesh
    from PIL import Image

    vertices, scene, texture = surface.vertices_m @ R.T, trimesh.Scene(), {}
    size = np.array(surface.atlas.shape[1::-1])
    if textured and surface.atlas.size:
        texture["baseColorTexture"] = Image.fromarray(surface.atlas)
    material = trimesh.visual.material.PBRMaterial(name="planes", **LOOK, **texture)
    for plane in range(-1, len(surface.plane_ids)):
        mine = surface.instances == plane
        if not mine.any():
            continue
        used, corners = np.unique(surface.triangles[mine], return_inverse=True)
        options: dict[str, Any] = {"vertex_colors": surface.colors[used]}
        if textured and plane >= 0:
            texels = np.empty((len(used), 2))
            texels[corners.reshape(-1)] = surface.texels[mine].reshape(-1, 2)
            u, v = ((texels + 0.5) / size).T
            visual = trimesh.visual.TextureVisuals(uv=np.stack([u, 1.0 - v], axis=1), material=material)  # trimesh counts rows from below
            normals = np.tile(R @ surface.coefficients[plane, :3], (len(used), 1))
            options = {"visual": visual, "vertex_normals": normals, "metadata": _facts(surface, plane, R)}
        mesh = trimesh.Trimesh(vertices[used], corners.reshape(-1, 3), process=False, **options)
        scene.add_geometry(mesh, node_name=_name(surface, plane), geom_name=_name(surface, plane))
    return scene


def _finish_gltf(tree: dict[str, Any]) -> None:
    """Give nodes the facts of their planes, coloured vertices a material, all materials no further light, and the texture no repetition."""
    for node in tree["nodes"]:
        facts = tree["meshes"][node["mesh"]].pop("extras", None) if "mesh" in node else None
        if facts:
            node["extras"] = facts
    painted = {"name": "rest", "pbrMetallicRoughness": {key: value for key, value in LOOK.items() if key != "doubleSided"}, "doubleSided": True}
    tree.setdefault("materials", []).append(painted)
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            primitive.setdefault("material", len(tree["materials"]) - 1)
    for material in tree["materials"]:
        material["extensions"] = {UNLIT: {}}
    tree["extensionsUsed"] = [UNLIT]
    for texture in tree.get("textures", []):
        texture["sampler"] = 0
        tree["samplers"] = [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}]  # linear, clamped


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
    write_file(path, json.dumps(content, indent=1) + "\n")
    return _summary(surface)


def _name(surface: Surface, plane: int) -> str:
    return f"{PLANE_KINDS[surface.kinds[plane]]}_{surface.plane_ids[plane]}" if plane >= 0 else "rest"


def _facts(surface: Surface, plane: int, R: F64) -> dict[str, Any]:
    """Facts about a plane; normal·x + d = 0 in the file's axes."""
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
