"""The files of a building: `building.json`, floor plans as SVG and DXF, and the model as glTF, all in metres in the building's frame (see
`types.Building`).

A plan shows one storey beside the other, from the lowest. Walls whose other face was not seen are drawn with one line's width; dashed is what was not
seen: stretches of walls without a reading, and edges of rooms that nothing bounds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from trihedron.pipeline.core.descriptions import summary_of_building
from trihedron.pipeline.core.files import new_file, write_file
from trihedron.pipeline.core.linalg import norm
from trihedron.pipeline.core.plan_areas import area_interval, area_sigma, edge_sigma, seen_share
from trihedron.pipeline.core.registry import register_files
from trihedron.pipeline.core.types import ELEMENTS, F64, OPENING_KINDS, SUPPORTS, Building
from trihedron.plugins.building.edits import missing_edits
from trihedron.plugins.building.geometry import (
    CEILING,
    MODEL_COLORS,
    door_swing,
    doors_on,
    label_place,
    open_edges,
    parts_of,
    quad,
    rings_of,
    rooms_on,
    wall_corners,
    wall_pieces,
)
from trihedron.plugins.building.labels import LISTS, id_of, label_of, name_of, parse_edits, plain_edits, use_of

JSON, SVG, DXF, GLB = "building.json", "floorplan.svg", "floorplan.dxf", "building.glb"
SCHEMA_VERSION = 1


@register_files("building")
def write_building(out: Path, building: Building) -> list[str]:
    """Write the files of a run folder; returns a line that describes them, and one for each correction by hand that no element has."""
    write_json(out / JSON, building)
    write_svg(out / SVG, building)
    write_dxf(out / DXF, building)
    write_glb(out / GLB, building)
    return [summary(building), *missing_edits(building)]


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


# SVG.

PX = 60.0  # a metre
NARROW_M = 1.9  # room, of small letters
LINE_PX, LETTER_PX = 15.0, 6.6  # of the legend: between lines, and a letter
STYLE = """
text{font-family:Helvetica,Arial,sans-serif;fill:#222;text-anchor:middle}
.room{fill:#eef3f8;stroke:none}.wall{fill:#333;stroke:#333;stroke-width:1}.unseen{fill:none;stroke:#c33;stroke-width:2;stroke-dasharray:7 5}
.swing{fill:none;stroke:#777;stroke-width:1}.leaf{stroke:#555;stroke-width:2}.glass{fill:#fff;stroke:#38c;stroke-width:1.5}
.name{font-size:15px;font-weight:bold}.area{font-size:13px}.small{font-size:9px}.length{font-size:10px;fill:#666}.note{font-size:12px;text-anchor:start}
"""


def write_svg(path: Path, building: Building) -> None:
    """Write the plan as SVG."""
    write_file(path, floorplan_svg(building))


def floorplan_svg(building: Building) -> str:
    """Return the plan as SVG: rooms with areas, lengths of their edges, walls, openings, a scale bar and north, the first camera's view."""
    parts, x = [], 0.0
    low, high = _extent(building)
    size = high - low
    for storey in range(max(len(building.storeys), 1)):
        shift = np.array([x, 0.0])
        parts += _svg_storey(
            building, storey, lambda p, shift=shift: PX * np.stack([p[..., 0] - low[0] + shift[0] + 1.0, high[1] - p[..., 1] + 1.0], -1)
        )
        x += float(size[0]) + 1.5
    legend, wide = _legend(building, PX * (float(size[1]) + 2.3))
    parts += legend
    width, height = max(PX * (x + 0.5), wide), PX * (float(size[1]) + 2.3) + LINE_PX * max(len(building.storeys) + 1.5, 3.0)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" viewBox="0 0 {width:.0f} {height:.0f}">'
    return "\n".join([head, f"<style>{STYLE}</style>", '<rect width="100%" height="100%" fill="#fff"/>', *parts, "</svg>", ""])


def _extent(building: Building) -> tuple[F64, F64]:
    points = np.concatenate([building.corners_m, building.walls_m.reshape(-1, 2)])
    return (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.array([3.0, 1.0]))


def _svg_storey(building: Building, storey: int, at: Any) -> list[str]:
    out = []
    for room in rooms_on(building, storey):
        rings = [at(ring) for ring in rings_of(building, room)]
        out += _svg_group(building, "room", room, [f'<path class="room" fill-rule="evenodd" d="{" ".join(_path(ring) for ring in rings)}"/>'])
    for wall in np.nonzero(building.wall_storeys == storey)[0]:
        pieces = [f'<path class="{"wall" if piece.seen else "unseen"}" d="{_path(at(piece.corners))}"/>' for piece in wall_pieces(building, wall)]
        out += _svg_group(building, "wall", int(wall), pieces)
    out += [f'<path class="wall" d="{_path(at(corner))}"/>' for room in rooms_on(building, storey) for corner in wall_corners(building, room)]
    for room in rooms_on(building, storey):
        for edge in open_edges(building, room):
            (x0, y0), (x1, y1) = at(edge)
            out.append(f'<line class="unseen" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>')
    for opening, wall in enumerate(building.opening_walls):
        if building.wall_storeys[wall] == storey:
            out += _svg_group(building, "opening", opening, _svg_opening(building, opening, at))
    for room in rooms_on(building, storey):
        out += _svg_texts(building, room, at)
    return out


def _svg_group(building: Building, element: str, k: int, parts: list[str]) -> list[str]:
    """Group what is drawn of an element under its id, with its name as title."""
    title = " – ".join(escape(text) for text in (label_of(building, element, k), use_of(building, k) if element == "room" else "") if text)
    return [f'<g id="{id_of(building, element, k)}"><title>{title}</title>', *parts, "</g>"]


def _path(points: F64) -> str:
    return "M" + " L".join(f"{x:.1f} {y:.1f}" for x, y in points) + " Z"


def _svg_opening(building: Building, opening: int, at: Any) -> list[str]:
    """Draw a window as glass, a door as a leaf with its swing, a passage as a gap. Which way a door turns is not known: a convention."""
    kind, wall = OPENING_KINDS[building.opening_kinds[opening]], int(building.opening_walls[opening])
    corners = at(quad(building, wall, *building.spans_m[opening]))
    if kind == "window":
        return [f'<path class="glass" d="{_path(corners)}"/>']
    if kind == "passage":
        return []
    hinge, tip, _, leaf = at(door_swing(building, opening))
    width = float(norm(tip - hinge))
    cross = (tip - hinge)[0] * (leaf - hinge)[1] - (tip - hinge)[1] * (leaf - hinge)[0]
    arc = f"M{leaf[0]:.1f} {leaf[1]:.1f} A{width:.1f} {width:.1f} 0 0 {1 if cross < 0 else 0} {tip[0]:.1f} {tip[1]:.1f}"
    return [
        f'<line class="leaf" x1="{hinge[0]:.1f}" y1="{hinge[1]:.1f}" x2="{leaf[0]:.1f}" y2="{leaf[1]:.1f}"/>',
        f'<path class="swing" d="{arc}"/>',
    ]  # fmt: skip


def area_text(building: Building, room: int) -> str:
    """Return the area of a room: with its standard deviation where that tells all, else with its 95 % interval; "seen" where its walls were not seen
    all round."""
    area, sigma, (low, high) = float(building.areas_m2[room]), area_sigma(building, room), area_interval(building, room)
    if building.closed[room] and abs(low + high - 2.0 * area) < LOPSIDED * (high - low):
        return f"{area:.2f} ± {sigma:.2f} m²"
    return f"{area:.2f} m²{'' if building.closed[room] else ' seen'} ({low:.1f} to {high:.1f})"


LOPSIDED = 0.2  # of an interval, by which its middle is off the area, from which a plan has both ends
LONGEST_UNLABELLED_M = 0.8
ALONG = (0.5, 0.35, 0.65, 0.2, 0.8)  # shares of an edge where its length is written, the first that is free
LETTERS_PX = {"name": 8.5, "area": 7.4, "length": 6.0, "small": 5.2}  # about the width of a letter


def _svg_texts(building: Building, room: int, at: Any) -> list[str]:
    """Write name and area of a room, and the lengths of its edges that are walls, beside each other and the swings of doors."""
    import shapely

    x, y = at(label_place(building, room))
    small = " small" if np.ptp(rings_of(building, room)[0], axis=0).min() < NARROW_M else ""
    name, area, below = label_of(building, "room", room), area_text(building, room), 11.0 if small else 17.0
    out = [
        f'<text class="name{small}" x="{x:.1f}" y="{y:.1f}">{escape(name)}</text>',
        f'<text class="area{small}" x="{x:.1f}" y="{y + below:.1f}">{area}</text>',
    ]
    half = max(len(name) * LETTERS_PX["small" if small else "name"], len(area) * LETTERS_PX["small" if small else "area"]) / 2.0
    taken = [shapely.box(x - half, y - below, x + half, y + below + 3.0)]
    taken += [shapely.Polygon(at(door_swing(building, door))) for door in doors_on(building, int(building.room_storeys[room]))]
    for of, a, b in building.loops:
        corners, walls = building.corners_m[a:b], building.corner_walls[a:b]
        for p, q, wall in zip(corners, np.roll(corners, -1, axis=0), walls) if of == room else ():
            if wall >= 0 and norm(q - p) >= LONGEST_UNLABELLED_M:
                text, box = _length_text(p, q, at, taken)
                taken.append(box)
                out.append(text)
    return out


def _length_text(p: F64, q: F64, at: Any, taken: list[Any]) -> tuple[str, Any]:
    """Write the length of an edge on its left where nothing is yet, and return its box."""
    import shapely
    from shapely.affinity import rotate

    length = float(norm(q - p))
    along = (q - p) / length
    angle = (-float(np.degrees(np.arctan2(along[1], along[0]))) + 90.0) % 180.0 - 90.0
    half = len(f"{length:.2f}") * LETTERS_PX["length"] / 2.0
    found = []
    for share in ALONG:
        x, y = at(p + share * (q - p) + 0.16 * np.array([-along[1], along[0]]))
        box = rotate(shapely.box(x - half, y - 5.0, x + half, y + 5.0), angle, origin=(x, y))
        found.append((sum(box.intersection(other).area for other in taken), x, y, box))
    _, x, y, box = min(found, key=lambda item: item[0])
    return f'<text class="length" x="{x:.1f}" y="{y + 3.5:.1f}" transform="rotate({angle:.1f} {x:.1f} {y:.1f})">{length:.2f}</text>', box


def _legend(building: Building, y: float) -> tuple[list[str], float]:
    """Draw scale bar, north, heights and the note; returns the width that they take too."""
    out = [f'<path d="M{PX:.0f} {y:.0f} h{2 * PX:.0f} m0 -5 v10 M{PX:.0f} {y - 5:.0f} v10 M{2 * PX:.0f} {y - 4:.0f} v8" fill="none" stroke="#222"/>']
    out += [f'<text class="length" x="{(1 + k) * PX:.0f}" y="{y + 18:.0f}">{k} m</text>' for k in range(3)]
    x = 4.0 * PX
    out.append(f'<path d="M{x:.0f} {y + 8:.0f} v-30 m-6 10 l6 -12 l6 12" fill="none" stroke="#222"/>')
    out.append(f'<text class="length" x="{x:.0f}" y="{y + 20:.0f}">N: first view</text>')
    heights = [f"storey {k}: floor {_height(low)}, ceiling {_height(high)}" for k, (low, high) in enumerate(building.storeys)]
    lines = [*heights, *([building.note] if building.note else []), "dashed: not seen"]
    out += [f'<text class="note" x="{5.0 * PX:.0f}" y="{y - 14 + LINE_PX * k:.0f}">{escape(line)}</text>' for k, line in enumerate(lines)]
    return out, 5.5 * PX + LETTER_PX * max(len(line) for line in lines)


def _height(value: float) -> str:
    return f"{value + 0.0:.2f} m".replace("-0.00", "0.00") if np.isfinite(value) else "not seen"


# DXF.

LAYERS = {"ROOMS": 8, "WALLS": 7, "UNSEEN": 1, "DOORS": 3, "WINDOWS": 5, "TEXT": 2}  # name -> AutoCAD colour


def write_dxf(path: Path, building: Building) -> None:
    """Write the plan as DXF R2010 in metres, with a layer for each of LAYERS."""
    import ezdxf
    from ezdxf import units
    from ezdxf.enums import TextEntityAlignment

    document = ezdxf.filemanagement.new("R2010", setup=["linetypes"])
    document.units = units.M
    for name, color in LAYERS.items():
        document.layers.add(name, color=color, linetype="DASHED" if name == "UNSEEN" else "CONTINUOUS")
    space, low_high = document.modelspace(), _extent(building)
    pitch = float(low_high[1][0] - low_high[0][0]) + 1.5
    for storey in range(len(building.storeys)):
        shift = np.array([storey * pitch, 0.0])
        for room in rooms_on(building, storey):
            for of, a, b in building.loops:
                if of == room:
                    space.add_lwpolyline((building.corners_m[a:b] + shift).tolist(), close=True, dxfattribs={"layer": "ROOMS"})
            for p, q in open_edges(building, room):
                space.add_line((p + shift).tolist(), (q + shift).tolist(), dxfattribs={"layer": "UNSEEN"})
            text = " – ".join(filter(None, (label_of(building, "room", room), use_of(building, room)))) + f": {area_text(building, room)}"
            label = space.add_text(text, height=0.15, dxfattribs={"layer": "TEXT"})
            label.set_placement((label_place(building, room) + shift).tolist(), align=TextEntityAlignment.MIDDLE_CENTER)
        for wall in np.nonzero(building.wall_storeys == storey)[0]:
            for piece in wall_pieces(building, wall):
                layer = "WALLS" if piece.seen else "UNSEEN"
                space.add_lwpolyline((piece.corners + shift).tolist(), close=True, dxfattribs={"layer": layer})
        for opening, wall in enumerate(building.opening_walls):
            if building.wall_storeys[wall] == storey:
                layer = "WINDOWS" if OPENING_KINDS[building.opening_kinds[opening]] == "window" else "DOORS"
                corners = quad(building, int(wall), *building.spans_m[opening]) + shift
                space.add_lwpolyline(corners.tolist(), close=True, dxfattribs={"layer": layer})
                if name := name_of(building, "opening", opening):
                    label = space.add_text(name, height=0.1, dxfattribs={"layer": "TEXT"})
                    label.set_placement(corners.mean(axis=0).tolist(), align=TextEntityAlignment.MIDDLE_CENTER)
    with new_file(path) as new:
        document.saveas(new)


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
