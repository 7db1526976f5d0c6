"""Floor plans as drawings: dimensions round the plan, labels that cross nothing, a legend in words."""

from __future__ import annotations

import json
import re
import sys
import zlib
from dataclasses import replace
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest
import shapely
from two_rooms import two_rooms

import trihedron as th
from trihedron.pipeline.core.errors import LibraryError
from trihedron.pipeline.core.registry import write_files_of
from trihedron.pipeline.core.types import OPENING_KINDS, Building
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.plugins.building import dxf
from trihedron.plugins.building.dimensions import chains_of
from trihedron.plugins.building.files import write_building
from trihedron.plugins.building.geometry import box_place
from trihedron.plugins.building.legend import FIGURES
from trihedron.plugins.building.pdf import write_pdf
from trihedron.plugins.building.plan_drawing import draw_plan
from trihedron.plugins.building.sheet import FONTS, Letters, Shape, Sheet
from trihedron.plugins.building.svg import floorplan_svg
from trihedron.tools import building as command

PX = 60.0  # a metre of the SVG


def texts_of(building: Building, name: str = "") -> list[str]:
    """The texts of the SVG, in order."""
    return [text.text or "" for text in ElementTree.fromstring(floorplan_svg(building, name)).iter("{http://www.w3.org/2000/svg}text")]


def crossings(sheet: Sheet, fonts: tuple[str, ...] = ("name", "area", "name small", "area small", "height")) -> list[str]:
    """Texts inside the plan that touch a wall or a line, or any other text."""
    letters = [mark for mark in sheet.marks() if isinstance(mark, Letters)]
    drawn = [mark for mark in sheet.marks() if isinstance(mark, Shape) and mark.style not in ("room", "dimension", "tick")]
    shapes = [shapely.MultiPoint(mark.rings[0]).convex_hull for mark in drawn]
    inside = [mark for mark in letters if mark.font in fonts]
    return [
        mark.text
        for mark in inside
        if any(mark.box().intersects(shape) for shape in shapes) or any(mark.box().intersects(other.box()) for other in letters if other is not mark)
    ]


def with_window(building: Building) -> Building:
    """A window in the south wall of the first room too."""
    return replace(
        building, opening_walls=np.array([0, 1], np.int32), opening_kinds=np.array([0, OPENING_KINDS.index("window")], np.uint8),
        spans_m=np.array([[1.0, 1.9], [1.0, 2.5]]), opening_heights_m=np.array([[0.0, 2.1], [0.9, 2.0]]),
        opening_covariance=np.tile(np.eye(4) * 1e-4, (2, 1, 1)), opening_rooms=np.array([[0, 1], [0, -1]], np.int32),
    )  # fmt: skip


def shrunk(building: Building, share: float) -> Building:
    """The same building, smaller."""
    return replace(building, walls_m=building.walls_m * share, corners_m=building.corners_m * share, spans_m=building.spans_m * share)


def test_chains_measure_the_rooms_the_wall_between_them_and_the_whole():
    across, upright = chains_of(two_rooms(), 0)
    assert np.array(across.stretches) == pytest.approx(np.array([[0.0, 4.0], [4.0, 4.1], [4.1, 8.1]])) and across.whole == pytest.approx((0.0, 8.1))
    assert np.array(upright.stretches) == pytest.approx(np.array([[0.0, 3.0]])) and upright.whole is None
    assert [(chain.axis, chain.high) for chain in (across, upright)] == [(0, False), (1, False)]  # the others would say the same


def test_a_side_of_other_stretches_has_a_chain_of_its_own():
    building = two_rooms()
    corners = building.corners_m.copy()
    corners[6] = corners[7] = [4.1, 2.0]  # the second room's west wall is shorter, its north wall slants
    corners[6] = [8.1, 3.0]
    across = [chain for chain in chains_of(replace(building, corners_m=corners), 0) if chain.axis == 1]
    assert [chain.high for chain in across] == [False]  # both sides see 3 m
    longer = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.5], [0.0, 3.5], [4.1, 0.0], [8.1, 0.0], [8.1, 3.0], [4.1, 3.0]])
    sides = [chain for chain in chains_of(replace(building, corners_m=longer), 0) if chain.axis == 1]
    assert [(chain.high, chain.stretches) for chain in sides] == [(False, ((0.0, 3.5),)), (True, ((0.0, 3.0), (3.0, 3.5)))]


def test_what_nothing_bounds_is_not_measured():
    building = two_rooms()
    walls = building.corner_walls.copy()
    walls[0] = walls[2] = -1  # south and north of the first room
    across, _ = chains_of(replace(building, corner_walls=walls), 0)
    assert np.array(across.stretches) == pytest.approx(np.array([[4.0, 4.1], [4.1, 8.1]])) and across.whole is None


def test_the_plan_has_dimensions_heights_and_areas_and_no_length_twice():
    texts = texts_of(with_window(two_rooms()))
    numbers = [text for text in texts if re.fullmatch(r"\d+\.\d\d", text)]
    assert sorted(numbers) == ["0.10", "2.10", "3.00", "4.00", "4.00", "8.10"]
    assert "sill 0.90, head 2.00" in texts and "2.10" in texts
    assert "room 0" in texts and "12.00 ± 0.01 m²" in texts


@pytest.mark.parametrize("share", [1.0, 0.6, 0.4, 0.25])
def test_no_letters_cross_a_wall_a_swing_or_each_other(share):
    building = shrunk(with_window(two_rooms()), share)
    assert crossings(draw_plan(building, PX)) == []
    assert crossings(draw_plan(two_rooms(), PX * share), (*FONTS,)) == []


def test_a_name_that_has_no_place_is_a_number_of_the_legend():
    texts = texts_of(shrunk(two_rooms(), 0.2))
    assert "room 0" not in texts
    assert {"1", "2", "1: room 0, 12.00 ± 0.01 m²", "2: room 1, 12.00 ± 0.01 m²"} <= set(texts)


def test_a_box_lies_where_it_is_farthest_from_the_outline():
    corner = shapely.Polygon([(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)])
    assert box_place(corner, 2.0, 0.5)[1] == pytest.approx(0.5, abs=0.03)
    assert box_place(corner, 0.5, 2.0)[0] == pytest.approx(0.5, abs=0.03)
    assert box_place(corner, 2.0, 1.2) is None


def test_the_legend_says_in_words_what_is_drawn():
    texts = texts_of(with_window(two_rooms()))
    legend = ["wall, seen", "wall, completed where it was not seen", "window", "door; which way it turns was not measured"]
    assert set([*legend, "between the inner faces of walls, m", "thin walls: the other face was not seen", "N: first view", FIGURES]) <= set(texts)
    assert "floor of storey 0: 24.00 m² in 2 rooms (24.0 to 24.0); floor 0.00 m, ceiling 2.50 m" in texts
    open_room = replace(two_rooms(), corner_walls=np.array([1, 0, -1, 3, 4, 5, 6, 0], np.int32))
    assert "not seen: nothing is known to bound the room there" in texts_of(open_room) and "window" not in texts_of(two_rooms())


def test_a_doubt_of_one_room_is_in_the_interval_of_the_floor():
    building = replace(two_rooms(), doubts=np.array([[0.0, 2.0, 0.3]]))
    assert "24.00 m² in 2 rooms (24.0 to 26.0)" in " ".join(texts_of(building))


def test_walls_without_a_room_are_a_plan_with_a_sentence():
    none = two_rooms()
    walls = replace(
        none, room_storeys=none.room_storeys[:0], loops=none.loops[:0], corners_m=none.corners_m[:0], corner_walls=none.corner_walls[:0],
        edge_sigma_m=none.edge_sigma_m[:0], areas_m2=none.areas_m2[:0], area_variance=none.area_variance[:0], closed=none.closed[:0],
        opening_rooms=np.array([[-1, -1]], np.int32),
    )  # fmt: skip
    assert "no room: 7 walls that were seen; floor 0.00 m, ceiling 2.50 m" in texts_of(walls)
    assert texts_of(walls).count("4.00") == 4


def test_the_title_is_the_run_and_its_day_where_the_stamps_tell_one(tmp_path):
    assert texts_of(two_rooms())[-20:].count("Floor plan") == 1
    assert "Floor plan of walk & <talk>" in texts_of(two_rooms(), "walk & <talk>")
    assert "Floor plan of walk, 2026-01-02" in texts_of(replace(two_rooms(), stamp_ns=1767312000 * 10**9), "walk")
    (tmp_path / "walk").mkdir()
    write_files_of("building", tmp_path / "walk", two_rooms())
    assert (tmp_path / "walk" / "floorplan.svg").read_text() == floorplan_svg(two_rooms(), "walk")


def test_the_sheet_is_cropped_to_what_is_drawn():
    sheet = draw_plan(two_rooms(), PX)
    points = np.concatenate([mark.corners() for mark in sheet.marks()])
    assert points.min(axis=0) == pytest.approx([14.0, 14.0]) and points.max(axis=0) == pytest.approx(sheet.size - 14.0)
    assert 8.1 * PX < sheet.size[0] < 8.1 * PX + 100.0


def operators_of(path) -> str:
    """The drawing operators of a PDF."""
    return zlib.decompress(re.search(rb"stream\r?\n(.*?)\r?\nendstream", path.read_bytes(), re.DOTALL)[1]).decode("latin-1")


def page_mm(path) -> list[float]:
    """Width and height of the page of a PDF."""
    box = re.search(rb"/MediaBox \[([^\]]*)\]", path.read_bytes())[1].split()
    return [round(float(value) / 72.0 * 25.4, 2) for value in box[2:]]


@pytest.mark.parametrize(
    ("size", "scale", "page"),
    [(1.0, 50, [210.0, 297.0]), (1.5, 50, [297.0, 210.0]), (2.0, 50, [420.0, 297.0]), (3.0, 100, [297.0, 210.0]), (6.0, 200, [297.0, 210.0])],
)
def test_a_metre_is_as_long_in_the_pdf_as_its_scale_says(tmp_path, size, scale, page):
    path = th.Building(shrunk(two_rooms(), size)).to_pdf(tmp_path / "plan.pdf", name="walk")
    assert page_mm(path) == pytest.approx(page, abs=0.01)
    lines = [[float(number) for number in line] for line in re.findall(r"(\S+) (\S+) m\n(\S+) (\S+) l\n", operators_of(path))]
    lengths_mm = [np.hypot(x1 - x0, y1 - y0) * 25.4 / 72.0 for x0, y0, x1, y1 in lines]
    for metres in (10.0 if scale == 200 else 2.0, 8.1 * size, 3.0 * size):  # the scale bar, and two dimensions
        assert min(abs(length - metres * 1000.0 / scale) for length in lengths_mm) < 0.001


def test_what_fits_no_paper_has_a_page_of_its_own_and_equal_plans_are_equal_files(tmp_path):
    building = shrunk(two_rooms(), 20.0)
    for name in ("a.pdf", "b.pdf"):
        write_pdf(tmp_path / name, building, "$walk$")
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
    assert page_mm(tmp_path / "a.pdf")[0] > 810.0


def test_without_matplotlib_one_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(LibraryError) as error:
        th.Building(two_rooms()).to_pdf(tmp_path / "plan.pdf")
    assert str(error.value) == "matplotlib: is not installed; install it with: pip install matplotlib" and list(tmp_path.iterdir()) == []


def test_the_command_writes_the_pdf_where_it_is_asked_for(tmp_path, capsys):
    (tmp_path / "walk").mkdir()
    writer = RecordingWriter(tmp_path / "walk" / "run.mcap", {"overrides": "[]", "config": "seed: 0"})
    writer.write("building", two_rooms())
    writer.close()
    assert command.main([str(tmp_path / "walk"), "--out", str(tmp_path / "plan"), "--pdf"]) == 0
    assert f"  {tmp_path}/plan/floorplan.pdf\n" in capsys.readouterr().out
    th.Building(two_rooms()).to_pdf(tmp_path / "walk.pdf", name="walk")
    plan = tmp_path / "plan" / "floorplan.pdf"
    assert plan.read_bytes() == (tmp_path / "walk.pdf").read_bytes()
    found = json.loads((plan.parent / "building.json").read_text())
    found["rooms"][0]["name"] = "Kitchen"
    (tmp_path / "edited.json").write_text(json.dumps(found))
    assert command.main([str(tmp_path / "walk"), "--out", str(plan.parent), "--edits", str(tmp_path / "edited.json")]) == 0
    assert f"  {plan}\n" in capsys.readouterr().out  # made again, as it was there
    assert plan.read_bytes() != (tmp_path / "walk.pdf").read_bytes()


def test_the_dxf_has_the_usual_layers_walls_that_are_joined_and_dimensions(tmp_path):
    building = replace(with_window(two_rooms()), unseen=np.empty((0, 3)))
    document = ezdxf.readfile(th.Building(building).to_dxf(tmp_path / "plan.dxf"))
    audit, space = document.audit(), document.modelspace()
    assert audit.errors == [] and audit.fixes == []
    names = {"A-WALL", "A-WALL-UNSN", "A-DOOR", "A-GLAZ", "A-AREA", "A-ANNO-DIMS", "A-ANNO-TEXT"}
    assert {layer.dxf.name for layer in document.layers} - {"0", "Defpoints"} == names
    rings = space.query('LWPOLYLINE[layer=="A-WALL"]')
    outer, inner = sorted((shapely.Polygon(ring.get_points("xy")) for ring in rings), key=lambda ring: -ring.area)
    assert all(ring.closed for ring in rings) and outer.bounds == pytest.approx((-0.06, -0.06, 8.16, 3.06), abs=0.001)
    assert inner.area == pytest.approx(4.0 * 3.0 * 2 + 0.1 * 0.9, abs=0.01)  # both rooms and the door between them
    assert outer.covers(inner) and len(outer.exterior.coords) == 5
    measured = sorted(round(one.get_measurement(), 2) for one in space.query('DIMENSION[layer=="A-ANNO-DIMS"]'))
    assert measured == [0.1, 3.0, 4.0, 4.0, 8.1]
    written = sorted(text.text for one in space.query("DIMENSION") for text in one.get_geometry_block().query("MTEXT"))
    assert written == ["0.10", "3.00", "4.00", "4.00", "8.10"]
    (arc,) = space.query('ARC[layer=="A-DOOR"]')
    assert arc.dxf.radius == pytest.approx(0.9) and (arc.dxf.end_angle - arc.dxf.start_angle) % 360.0 == pytest.approx(90.0)
    assert len(space.query('LWPOLYLINE[layer=="A-GLAZ"]')) == 1 and len(space.query('LWPOLYLINE[layer=="A-AREA"]')) == 2


def test_walls_that_were_not_seen_are_on_a_layer_of_their_own(tmp_path):
    space = ezdxf.readfile(th.Building(two_rooms()).to_dxf(tmp_path / "plan.dxf")).modelspace()
    (ring,) = space.query('LWPOLYLINE[layer=="A-WALL-UNSN"]')
    assert shapely.Polygon(ring.get_points("xy")).bounds == pytest.approx((3.0, 3.0, 3.5, 3.06), abs=0.002)
    assert len(space.query('LWPOLYLINE[layer=="A-WALL"]')) == 1  # the gap leads into the rooms


def test_without_ezdxf_the_other_files_are_written_and_a_line_names_it(tmp_path, monkeypatch):
    monkeypatch.setattr(dxf, "find_spec", lambda name: None)
    assert write_building(tmp_path, two_rooms())[1:] == ["no floorplan.dxf: ezdxf: is not installed; install it with: pip install ezdxf"]
    assert {file.name for file in tmp_path.iterdir()} == {"building.json", "floorplan.svg", "building.glb"}


def test_a_plan_of_nothing_is_a_dxf(tmp_path):
    none = th.Building(Building.empty(0, 0, "no plane was seen")).to_dxf(tmp_path / "none.dxf")
    assert ezdxf.readfile(none).audit().errors == []


def test_the_ifc_has_axes_a_material_and_the_evidence(tmp_path):
    import ifcopenshell
    from ifcopenshell.util.element import get_material, get_pset
    from ifcopenshell.validate import json_logger, validate

    model, logger = ifcopenshell.open(th.Building(with_window(two_rooms())).to_ifc(tmp_path / "model.ifc")), json_logger()
    validate(model, logger, express_rules=True)
    assert logger.statements == []
    walls = model.by_type("IfcWall")
    for wall, length in zip(walls, (3.0, 4.0, 4.0, 3.0, 4.0, 3.0, 4.0)):
        axis, body = sorted(wall.Representation.Representations, key=lambda shape: str(shape.RepresentationIdentifier))
        assert (axis.RepresentationIdentifier, axis.RepresentationType, body.RepresentationIdentifier) == ("Axis", "Curve2D", "Body")
        (first, last), depth = axis.Items[0].Points.CoordList, 0.1 if wall is walls[0] else 0.06
        assert first == pytest.approx((0.0, -depth / 2.0)) and last == pytest.approx((length, -depth / 2.0))
    assert {get_material(part).Name for part in [*walls, *model.by_type("IfcSlab")]} == {"unknown"}
    found = get_pset(walls[0], "Trihedron_Measurement")
    assert (found["OffsetSigma"], found["DirectionSigma"]) == (pytest.approx(0.01), pytest.approx(0.01))
    assert (found["Keyframes"], found["Frames"]) == (0, 1) and get_pset(walls[0], "Pset_WallCommon") is None
    assert get_pset(model.by_type("IfcOpeningElement")[0], "Trihedron_Measurement")["Frames"] == 1


def meshes_of(path, *kinds):
    """Name -> bounds (2, 3) and volume of the solids of a file, by IfcOpenShell's geometry, openings subtracted."""
    import ifcopenshell
    import ifcopenshell.geom
    import trimesh

    model, settings, found = ifcopenshell.open(path), ifcopenshell.geom.settings(), {}
    settings.set("use-world-coords", True)
    for shape in ifcopenshell.geom.iterator(settings, model, 1, include=[one for kind in kinds for one in model.by_type(kind)]):
        mesh = trimesh.Trimesh(np.reshape(shape.geometry.verts, (-1, 3)), np.reshape(shape.geometry.faces, (-1, 3)))
        found[model.by_id(shape.id).Name] = mesh.bounds, mesh.volume
    return found


def test_walls_of_the_ifc_meet_at_corners_and_stand_on_one_slab(tmp_path):
    solids = meshes_of(th.Building(two_rooms()).to_ifc(tmp_path / "model.ifc"), "IfcWall", "IfcSlab")
    walls = [shapely.box(*low[:2], *high[:2]) for name, ((low, high), _) in solids.items() if name.startswith("wall")]
    ring = shapely.box(-0.06, -0.06, 8.16, 3.06) - shapely.box(0.0, 0.0, 4.0, 3.0) - shapely.box(4.1, 0.0, 8.1, 3.0)
    assert shapely.union_all(walls).symmetric_difference(ring).area == pytest.approx(0.0, abs=1e-6)
    assert sum(wall.area for wall in walls) == pytest.approx(ring.area, abs=1e-6)  # none is in another
    assert solids["wall 0"][1] == pytest.approx(0.1 * (3.06 * 2.5 - 0.9 * 2.1), abs=1e-6)  # it takes one corner; the door is a hole
    for name, low, high in (("floor of storey 0", -0.2, 0.0), ("roof of storey 0", 2.5, 2.7)):
        assert solids[name][0] == pytest.approx(np.array([[-0.06, -0.06, low], [8.16, 3.06, high]]), abs=1e-6)


@pytest.mark.parametrize(("shift", "roofs"), [(0.0, {"roof of storey 0", "roof of storey 1"}), (-4.1, {"roof of storey 1"})], ids=["beside", "above"])
def test_a_storey_has_a_roof_where_no_other_is_above_it(tmp_path, shift, roofs):
    building = two_rooms()
    corners, walls = building.corners_m.copy(), building.walls_m.copy()
    corners[4:, 0] += shift
    walls[4:, :, 0] += shift
    upper = replace(
        building, corners_m=corners, walls_m=walls, storeys=np.array([[0.0, 2.5], [2.8, 5.3]]), storey_covariance=np.full((2, 2, 2), 1e-4),
        wall_storeys=np.array([0, 0, 0, 0, 1, 1, 1], np.int32), room_storeys=np.array([0, 1], np.int32),
        corner_walls=np.array([1, 0, 2, 3, 4, 5, 6, -1], np.int32),
    )  # fmt: skip
    slabs = meshes_of(th.Building(upper).to_ifc(tmp_path / "model.ifc"), "IfcSlab")
    assert {name for name in slabs if name.startswith("roof")} == roofs
    assert slabs["floor of storey 1"][0][:, 2] == pytest.approx((2.5, 2.8)) and slabs["roof of storey 1"][0][:, 2] == pytest.approx((5.3, 5.5))
