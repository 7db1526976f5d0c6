"""The files of a run folder: `building.json`, floor plans as SVG and DXF, and the model as glTF, all in metres in the building's frame (see
`types.Building`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.descriptions import summary_of_building
from trihedron.pipeline.core.errors import ConfigError, DataError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.libraries import library_error
from trihedron.pipeline.core.linalg import norm
from trihedron.pipeline.core.plan_areas import area_interval, area_sigma, edge_sigma, seen_share
from trihedron.pipeline.core.registry import register_files
from trihedron.pipeline.core.types import ELEMENTS, F64, OPENING_KINDS, SUPPORTS, Building
from trihedron.plugins.building.dxf import DXF, has_dxf, write_dxf
from trihedron.plugins.building.edits import WITHOUT_IDS, missing_edits, read_edits
from trihedron.plugins.building.geometry import CEILING, MODEL_COLORS, parts_of
from trihedron.plugins.building.ifc import IFC
from trihedron.plugins.building.labels import LISTS, Edit, id_of, name_of, parse_edits, plain_edits, use_of
from trihedron.plugins.building.pdf import PDF
from trihedron.plugins.building.svg import SVG, write_svg

JSON, GLB = "building.json", "building.glb"
SCHEMA_VERSION = 1


def check_edits(folder: Path, options: Mapping[str, Any] | None) -> None:
    """Raise ConfigError where a run with these options of the stage, None without it, would lose corrections by hand, and DataError where they have a
    mistake."""
    file, given = folder / JSON, "" if options is None else options.get("edits", "")
    if set(kept_edits(file)) - set(read_edits(given)):
        cure = "give another out=FOLDER" + (f", or building.edits={file}" if options is not None else "")
        raise ConfigError("out", f"{file} holds corrections by hand, which would be lost", cure)


def kept_edits(file: Path) -> tuple[Edit, ...]:
    """Return the corrections in a building.json that is to be replaced: none in one of an older version, nor in the target of a link, which stays.
    Raises DataError for one with a mistake."""
    try:
        return read_edits(str(file)) if file.exists() and not file.is_symlink() else ()
    except DataError as error:
        if error.cause == WITHOUT_IDS:
            return ()
        raise


@register_files("building", (JSON, SVG, PDF, DXF, GLB, IFC), check_edits)
def write_run_files(out: Path, building: Building) -> list[str]:
    """Write the files of a run folder, whose name the plan has; returns lines as `write_building` does."""
    return write_building(out, building, out.resolve().name)


def write_building(out: Path, building: Building, name: str = "") -> list[str]:
    """Write the files into a folder; returns a line that describes them, one for a file whose library is not installed, and one for each correction
    by hand that no element has. `name` is that of the run, for the plan's title."""
    write_json(out / JSON, building)
    write_svg(out / SVG, building, name)
    write_glb(out / GLB, building)
    without = [f"no {DXF}: {library_error('ezdxf')}"]
    if has_dxf():
        write_dxf(out / DXF, building)
        without = []
    return [summary(building), *without, *missing_edits(building)]


def summary(building: Building) -> str:
    """Return a line that describes a building."""
    return f"building: {summary_of_building(building)}"


# JSON.


def write_json(path: Path, building: Building) -> None:
    """Write all elements as JSON."""
    write_file(path, json.dumps(building_json(building), indent=1) + "\n")


def building_json(building: Building) -> dict[str, Any]:
    """Return the building as the documented schema (docs/reference/building.md): `storeys`, `walls`, `rooms`, `openings`; null = not seen."""
    return {
        "schema": SCHEMA_VERSION,
        "unit": "m",
        "note": building.note,
        "T_world_building": _numbers(building.T_world_building),
        "storeys": [_storey(building, k) for k in range(len(building.storeys))],
        "walls": [_wall(building, k) for k in range(len(building.walls_m))],
        "rooms": [_room(building, k) for k in range(len(building.areas_m2))],
        "openings": [_opening(building, k) for k in range(len(building.spans_m))],
        "furniture_planes": building.furniture.tolist(),
        "count": dict(zip(LISTS.values(), (len(building.walls_m), len(building.areas_m2), len(building.spans_m)))),
        "edits": plain_edits(parse_edits(building.edits)),
    }


def _named(building: Building, element: str, k: int) -> dict[str, str]:
    return {"id": id_of(building, element, k), "name": name_of(building, element, k)}


def _numbers(array: Any) -> Any:
    """Return nested lists rounded to a hundredth of a millimetre, None for NaN."""
    if isinstance(array, np.ndarray) and array.ndim:
        return [_numbers(row) for row in array]
    return round(float(array), 5) if np.isfinite(array) else None


def _sigmas(covariance: F64) -> list[float | None]:
    return [_numbers(value) for value in np.sqrt(np.diag(covariance))]


def _support(building: Building, kind: str, number: int) -> dict[str, list[int]]:
    rows = building.support[(building.support[:, 0] == ELEMENTS.index(kind)) & (building.support[:, 1] == number)]
    return {f"{name}s": rows[rows[:, 2] == k, 3].tolist() for k, name in enumerate(SUPPORTS)}


def _storey(building: Building, k: int) -> dict[str, Any]:
    (floor, ceiling), (floor_sigma, ceiling_sigma) = building.storeys[k], np.sqrt(np.diag(building.storey_covariance[k]))
    return {
        "floor_m": _numbers(floor), "ceiling_m": _numbers(ceiling), "height_m": _numbers(ceiling - floor),
        "floor_sigma_m": _numbers(floor_sigma), "ceiling_sigma_m": _numbers(ceiling_sigma), "support": _support(building, "storey", k),
    }  # fmt: skip


def _wall(building: Building, k: int) -> dict[str, Any]:
    start, end = building.walls_m[k]
    offset, thickness, angle = _sigmas(building.wall_covariance[k])
    return {
        **_named(building, "wall", k), "storey": int(building.wall_storeys[k]),
        "start": _numbers(start), "end": _numbers(end), "length_m": _numbers(norm(end - start)),
        "thickness_m": _numbers(building.thickness_m[k]), "offset_sigma_m": offset, "thickness_sigma_m": thickness, "direction_sigma_rad": angle,
        "unseen": [_numbers(row[1:]) for row in building.unseen if int(row[0]) == k], "support": _support(building, "wall", k),
    }  # fmt: skip


def _room(building: Building, k: int) -> dict[str, Any]:
    rings = [(int(a), int(b)) for room, a, b in building.loops if room == k]
    return {
        **_named(building, "room", k), "use": use_of(building, k), "storey": int(building.room_storeys[k]),
        "polygon": _numbers(building.corners_m[slice(*rings[0])]),
        "holes": [_numbers(building.corners_m[a:b]) for a, b in rings[1:]],
        "walls": [building.corner_walls[a:b].tolist() for a, b in rings], "area_m2": _numbers(building.areas_m2[k]),
        "area_sigma_m2": _numbers(area_sigma(building, k)), "area_interval_m2": _numbers(np.array(area_interval(building, k))),
        "edge_sigma_m": [[_numbers(edge_sigma(building, corner)) for corner in range(a, b)] for a, b in rings],
        "seen_share": _numbers(seen_share(building, k)), "closed": bool(building.closed[k]), "support": _support(building, "room", k),
    }  # fmt: skip


def _opening(building: Building, k: int) -> dict[str, Any]:
    return {
        **_named(building, "opening", k), "kind": OPENING_KINDS[building.opening_kinds[k]],
        "wall": int(building.opening_walls[k]), "rooms": building.opening_rooms[k].tolist(),
        "span_m": _numbers(building.spans_m[k]), "width_m": _numbers(np.ptp(building.spans_m[k])),
        "heights_m": _numbers(building.opening_heights_m[k]), "sigma_m": _sigmas(building.opening_covariance[k]),
        "support": _support(building, "opening", k),
    }  # fmt: skip


# glTF.


def write_glb(path: Path, building: Building) -> None:
    """Write the model as binary glTF 2.0: y up, -z north; a node for each kind of each storey."""
    import trimesh

    scene = trimesh.Scene()
    for part in parts_of(building):
        name, color = f"storey {part.storey} {part.kind}", MODEL_COLORS[part.kind]
        look: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0, "doubleSided": part.kind != CEILING}
        if color[3] < 255:
            look["alphaMode"] = "BLEND"
        material = trimesh.visual.material.PBRMaterial(name=part.kind, baseColorFactor=color, **look)
        flat = part.vertices_m[part.triangles].reshape(-1, 3)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        mesh = trimesh.Trimesh(flat, np.arange(len(flat)).reshape(-1, 3), process=False, visual=trimesh.visual.TextureVisuals(material=material))
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    if not scene.geometry:
        scene.add_geometry(trimesh.PointCloud(np.zeros((1, 3))), node_name=building.note or "empty")
    write_file(path, trimesh.exchange.gltf.export_glb(scene, include_normals=True))
