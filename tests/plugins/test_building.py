"""Plans of buildings: from exact frames of the simulator at their true poses, and from next to nothing."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

import trihedron as th
from trihedron.comparison.building_errors import plan_errors
from trihedron.datasets.simulation.synthetic import Scene, Synthetic
from trihedron.pipeline.core.drawings import Drawing
from trihedron.pipeline.core.errors import LibraryError, TrihedronError
from trihedron.pipeline.core.plan_areas import area_interval, area_sigma, seen_share
from trihedron.pipeline.core.registry import drawing_of, load_plugins, plugin_class
from trihedron.pipeline.core.types import OPENING_KINDS, Building, Camera, Frame, Planes, Pose
from trihedron.pipeline.record.foxglove import TopicView
from trihedron.plugins.building.cell_complex import Cells, cells_of, components, inside_cells
from trihedron.plugins.building.edges import Edge, end_at_readings, intersect_edges, make_relative, rotate_edge
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import Face
from trihedron.plugins.building.files import building_json, summary, write_building
from trihedron.plugins.building.free_space import CELL_M, FreeSpace
from trihedron.plugins.building.free_space_kernels import LEVELS
from trihedron.plugins.building.geometry import wall_pieces
from trihedron.plugins.building.ifc import has_ifc, write_ifc
from trihedron.plugins.building.jogs import jog_sides, parting_columns
from trihedron.plugins.building.openings import OpeningPlan, fit_jambs, is_niche, widest_gap
from trihedron.plugins.building.svg import floorplan_svg
from trihedron.plugins.building.tall_furniture import Stretch, wall_prior, wall_probability
from trihedron.plugins.building.views import spread_views
from trihedron.plugins.building.walls import WallPlan
from trihedron.plugins.mapping.insertion import add_keyframe
from trihedron.plugins.mapping.landmarks import empty_map
from trihedron.plugins.normals.integral_image import IntegralImage
from trihedron.plugins.planes.connected_components import ConnectedComponents
from trihedron.tools.benchmarks import building_benchmark

load_plugins()
LAYOUTS = ("manhattan_layout", "atlanta_layout", "cells")


def pose_at(index: int, T: np.ndarray) -> Pose:
    """A tracked pose without a keyframe."""
    return Pose(index, index, T, np.eye(6) * 1e-6, T, -1, np.zeros(3, np.int32), 0, "ok", "")


def folded(name: str, inputs: list[tuple[Frame, Planes, Pose]]):
    plugin = plugin_class("building", name)()
    state = plugin.start()
    for frame, planes, pose in inputs:
        state = plugin.add(state, frame, planes, None, pose, None)
    return plugin.finish(state, None)


def planes_of(frame: Frame) -> Planes:
    return ConnectedComponents()(frame, IntegralImage()(frame))


@pytest.fixture(scope="module")
def walk() -> tuple[Synthetic, list[tuple[Frame, Planes, Pose]]]:
    """Two offices on a corridor, every half a second."""
    dataset = Synthetic(scene=Scene.offices, fps=2.0, width=160, height=120, texture=False, noise=False)
    truth = dataset.truth()
    frames = [dataset(k) for k in range(len(dataset))]
    return dataset, [(frame, planes_of(frame), pose_at(k, truth.poses[k])) for k, frame in enumerate(frames)]


@pytest.fixture(scope="module")
def offices(walk):
    return {name: folded(name, walk[1]) for name in LAYOUTS}


def test_the_true_plan_of_the_offices_is_that_of_its_walls():
    (plan,) = Synthetic(scene=Scene.offices).plans()
    areas = sorted(0.5 * abs(np.sum(ring[:, 0] * np.roll(ring[:, 1], -1) - np.roll(ring[:, 0], -1) * ring[:, 1])) for (ring,) in plan.rooms)
    assert areas == pytest.approx([16.0, 16.0, 28.0], abs=1e-3)
    assert [size for door in plan.doorways for size in (door.width_m, door.height_m)] == pytest.approx([0.9, 2.1, 0.9, 2.1])
    assert len(Synthetic(scene=Scene.corridor).plans()[0].rooms[0]) == 2  # round a block


@pytest.mark.parametrize("name", LAYOUTS)
def test_rooms_walls_and_doorways_of_the_offices_are_found(walk, offices, name):
    figures = plan_errors(offices[name], np.eye(4), walk[0].plans())
    assert figures["room_recall"] == figures["room_precision"] == figures["door_recall"] == 1.0
    assert figures["iou"] >= 0.97 and figures["wall_m"] <= 0.01 and figures["height_m"] <= 0.01 and figures["area_error"] <= 0.02
    assert figures["door_precision"] == 1.0


def test_doors_join_the_corridor_with_an_office_each(offices):
    building = offices["manhattan_layout"]
    corridor = int(np.argmax(building.areas_m2))
    assert all(OPENING_KINDS[kind] == "door" for kind in building.opening_kinds)
    assert [corridor in rooms for rooms in building.opening_rooms.tolist()] == [True, True]
    assert len({room for rooms in building.opening_rooms.tolist() for room in rooms}) == 3
    assert np.ptp(building.spans_m, axis=1) == pytest.approx([0.9, 0.9], abs=0.06)


def test_the_plan_does_not_depend_on_the_world_it_is_tracked_in(walk, offices):
    turn = np.eye(4)
    turn[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    turn[:3, 3] = [3.0, -2.0, 5.0]
    moved = [(frame, planes, pose_at(pose.index, turn @ pose.T_world_camera)) for frame, planes, pose in walk[1]]
    again, before = folded("manhattan_layout", moved), offices["manhattan_layout"]
    assert again.areas_m2 == pytest.approx(before.areas_m2, abs=0.02)
    assert again.T_world_building == pytest.approx(turn @ before.T_world_building, abs=0.01)


def test_what_was_not_seen_is_marked_and_not_closed(walk):
    building = folded("manhattan_layout", walk[1][:12])
    assert not building.closed.all() and "not seen all round" in building.note
    assert (building.corner_walls == -1).any()
    assert 'class="unseen"' in floorplan_svg(building)


def test_the_files_hold_what_was_found_and_open_in_other_readers(offices, tmp_path):
    import ezdxf

    building = offices["manhattan_layout"]
    (line,) = write_building(tmp_path, building)
    assert line == summary(building) and line.startswith("building: 1 storey, 3 rooms of 59.")
    read = json.loads((tmp_path / "building.json").read_text())
    assert read == building_json(building)
    assert [len(read[key]) for key in ("storeys", "walls", "rooms", "openings")] == [1, len(building.walls_m), 3, 2]
    assert all(element["support"]["frames"] for key in ("storeys", "walls", "rooms", "openings") for element in read[key])
    ElementTree.fromstring((tmp_path / "floorplan.svg").read_text())
    document = ezdxf.readfile(tmp_path / "floorplan.dxf")
    assert not document.audit().errors
    assert len(document.modelspace().query('LWPOLYLINE[layer=="A-AREA"]')) == 3 and len(document.modelspace().query('ARC[layer=="A-DOOR"]')) == 2


def test_walls_are_cut_at_doors(offices):
    building = offices["manhattan_layout"]
    wall = int(building.opening_walls[0])
    pieces = list(wall_pieces(building, wall))
    cut = sum(float(np.linalg.norm(piece.corners[1] - piece.corners[0])) for piece in pieces)
    assert len(pieces) >= 3
    assert cut == pytest.approx(np.linalg.norm(np.diff(building.walls_m[wall], axis=0)) - np.ptp(building.spans_m, axis=1).sum(), abs=1e-6)


def test_walls_are_less_certain_the_farther_they_are(offices):
    """By the scale of depth, 0.07 % of the distance from the first camera, beside what no averaging removes."""
    building = offices["manhattan_layout"]
    (begin, end), sigma_m = building.walls_m.transpose(1, 0, 2), np.sqrt(building.wall_covariance[:, 0, 0])
    offset_m = np.abs(np.linalg.det(np.stack([begin, end], axis=1))) / np.linalg.norm(end - begin, axis=1)
    least = np.hypot(0.002, 0.0007 * offset_m)
    assert offset_m.max() > 5.0 and (sigma_m > least).all() and (sigma_m < 3.0 * least).all()


def test_ifc_and_gltf_hold_the_model(offices, tmp_path):
    import trimesh

    building = offices["manhattan_layout"]
    write_building(tmp_path, building)
    scene = trimesh.load(tmp_path / "building.glb")
    assert {"storey 0 wall", "storey 0 floor", "storey 0 ceiling"} <= set(scene.geometry)
    assert scene.geometry["storey 0 floor"].area == pytest.approx(building.areas_m2.sum(), abs=0.01)
    assert np.ptp(scene.bounds[:, 1]) == pytest.approx(np.ptp(building.storeys[0]), abs=1e-3)  # y is up
    import ifcopenshell
    from ifcopenshell.validate import json_logger, validate

    for name in ("a.ifc", "b.ifc"):
        write_ifc(tmp_path / name, building)
    model, logger = ifcopenshell.open(tmp_path / "a.ifc"), json_logger()
    validate(model, logger, express_rules=True)
    assert logger.statements == []
    counts = {"IfcBuildingStorey": 1, "IfcWall": len(building.walls_m), "IfcSpace": 3, "IfcOpeningElement": 2, "IfcSlab": 2}
    assert {kind: len(model.by_type(kind)) for kind in counts} == counts
    assert (
        sorted(part.is_a() for part in model.by_type("IfcRelAssociatesMaterial")[0].RelatedObjects)
        == ["IfcSlab"] * 2 + ["IfcWall"] * counts["IfcWall"]
    )
    names = [[root.GlobalId for root in ifcopenshell.open(tmp_path / name).by_type("IfcRoot")] for name in ("a.ifc", "b.ifc")]
    assert names[0] == names[1] and len(set(names[0])) == len(names[0])


def test_without_ifcopenshell_one_line_says_so(offices, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    with pytest.raises(LibraryError) as error:
        th.Building(offices["cells"]).to_ifc(tmp_path / "model.ifc")
    assert str(error.value) == "ifcopenshell: is not installed; install it with: pip install 'trihedron[ifc]'"
    assert not has_ifc() and list(tmp_path.iterdir()) == []


def test_a_browser_draws_the_plan(offices):
    import cairosvg

    picture = cairosvg.svg2png(floorplan_svg(offices["manhattan_layout"]).encode())
    assert picture.startswith(b"\x89PNG") and len(picture) > 5000


def test_rooms_and_distances_are_asked(walk, offices):
    plan = th.Building(offices["manhattan_layout"])
    corridor = max(plan.rooms, key=lambda room: room.area_m2.value)
    assert corridor.area_m2.value == pytest.approx(28.0, abs=0.3) and corridor.closed and len(corridor.openings) == 2
    assert sorted(edge.length_m.value for edge in corridor.edges) == pytest.approx([2.0, 2.0, 14.0, 14.0], abs=0.03)
    assert abs(corridor.perimeter_m.value - 32.0) < 1.96 * corridor.perimeter_m.sigma
    assert plan.room_of(walk[1][0][2]) is corridor and plan.room_of(walk[1][0][2].T_world_camera) is corridor
    assert plan.room_of(np.array([0.0, 0.0, 50.0])) is None
    ends = [plan.walls[edge.wall] for edge in corridor.edges if edge.length_m.value < 3.0]
    length = plan.distance(*ends)
    assert abs(length.value - 14.0) < 1.96 * length.sigma and length.sigma < 0.03
    first, second = plan.openings
    assert plan.distance(first, second).value == pytest.approx(6.8, abs=0.05)
    assert first.width_m.value == pytest.approx(0.9, abs=0.05) and {*first.rooms} <= {0, 1, 2}
    (storey,) = plan.storeys
    assert storey.ceiling_m.value == pytest.approx(2.7, abs=0.01) and str(storey.ceiling_m).startswith("2.69")
    long = next(plan.walls[edge.wall] for edge in corridor.edges if edge.length_m.value > 3.0)
    with pytest.raises(TrihedronError) as error:
        plan.distance(ends[0], long)
    named = f"walls {ends[0].number} and {long.number} are not parallel but at 90°"
    assert str(error.value) == f"distance: {named}; take parallel walls, or a wall and a point"
    with pytest.raises(TrihedronError) as error:
        plan.room_of("kitchen")
    assert str(error.value) == "room_of: is given str, no place; give a wall, an opening, a pose, a (4, 4) matrix or a point (3,)"


def test_outlines_are_polygons(offices):
    plan = th.Building(offices["manhattan_layout"])
    for room in plan.rooms:
        assert room.polygon.area == pytest.approx(room.area_m2.value, abs=1e-9)
        assert np.array_equal(room.polygon.exterior.coords[:-1], room.corners)
    for wall in plan.walls:
        thickness = wall.thickness_m.value if np.isfinite(wall.thickness_m.value) else 0.06
        assert wall.outline.area == pytest.approx(wall.length_m.value * thickness)
    for opening in plan.openings:
        assert plan.walls[opening.wall].outline.buffer(1e-9).covers(opening.outline)
        assert opening.outline.centroid.coords[0] == pytest.approx(opening.middle[:2])


def test_a_block_in_a_room_is_a_hole_of_its_polygon():
    ring, block = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]), np.array([[1.0, 1.0], [1.0, 2.0], [2.0, 2.0], [2.0, 1.0]])
    exact = th.buildings.Measurement(0.0, 0.0)
    room = th.buildings.Room(0, 0, ring, (block,), (), exact, exact, (), True)
    assert room.polygon.area == pytest.approx(11.0) and len(room.polygon.interiors) == 1


def test_each_file_is_written_alone(offices, tmp_path):
    plan = th.Building(offices["manhattan_layout"])
    plan.save(tmp_path / "all")
    alone = {"building.json": plan.to_json, "floorplan.svg": plan.to_svg, "floorplan.dxf": plan.to_dxf}
    alone |= {"building.glb": plan.to_glb, "model.ifc": plan.to_ifc}
    for name, write in alone.items():
        assert write(str(tmp_path / name)) == tmp_path / name
    assert sorted(alone) == sorted(path.name for path in (tmp_path / "all").iterdir())
    for name in ("building.json", "floorplan.svg", "building.glb"):
        assert (tmp_path / name).read_bytes() == (tmp_path / "all" / name).read_bytes()
    with pytest.raises(TrihedronError) as error:
        plan.to_svg(tmp_path / "nowhere" / "plan.svg")
    path = tmp_path / "nowhere" / "plan.svg"
    assert str(error.value) == f"{path}: cannot be written: No such file or directory; give a path in a folder that exists"


@pytest.mark.parametrize(
    ("scene", "name"),
    [
        ("flat", "manhattan_layout"),
        pytest.param("slanted_flat", "atlanta_layout", marks=pytest.mark.slow),
        pytest.param("slanted_flat", "cells", marks=pytest.mark.slow),
        pytest.param("house", "manhattan_layout", marks=pytest.mark.slow),
        pytest.param("whole_floor", "manhattan_layout", marks=pytest.mark.slow),
    ],
)
def test_wardrobes_slanted_walls_and_storeys(scene, name):
    """The flat has an L-shaped room, a wardrobe that is no wall, a door ajar and a window; the house and the whole floor two storeys."""
    dataset = Synthetic(scene=Scene[scene], fps=2.0, width=160, height=120, texture=False, noise=False)
    truth = dataset.truth()
    frames = [dataset(k) for k in range(len(dataset))]
    building = folded(name, [(frame, planes_of(frame), pose_at(k, truth.poses[k])) for k, frame in enumerate(frames)])
    figures = plan_errors(building, np.eye(4), dataset.plans())
    assert figures["room_recall"] == figures["room_precision"] == figures["door_recall"] == figures["door_precision"] == 1.0
    assert figures["iou"] >= 0.98 and figures["wall_m"] <= 0.01 and figures["area_error"] <= 0.02 and len(building.storeys) == len(dataset.plans())
    windows = [building.opening_heights_m[k] for k, kind in enumerate(building.opening_kinds) if OPENING_KINDS[kind] == "window"]
    if scene == "flat":
        assert len(windows) == 1 and windows[0] == pytest.approx([0.9, 2.0], abs=0.12)


@pytest.fixture(scope="module")
def furnished() -> tuple[Synthetic, Building]:
    """A flat of four rooms with niches, wardrobes, a shelf of 2 m and doors ajar, by a Kinect's depth."""
    dataset = Synthetic(scene=Scene.random_flat, flat=6, seed=6, fps=2.5, width=160, height=120, texture=False)
    truth = dataset.truth()
    frames = [dataset(k) for k in range(len(dataset))]
    return dataset, folded("manhattan_layout", [(frame, planes_of(frame), pose_at(k, truth.poses[k])) for k, frame in enumerate(frames)])


def test_furniture_is_no_wall_and_niches_belong_to_rooms(furnished):
    dataset, building = furnished
    figures = plan_errors(building, np.eye(4), dataset.plans())
    assert figures["room_f1"] == figures["door_recall"] == figures["door_precision"] == 1.0
    assert figures["iou"] > 0.99 and figures["wall_m"] < 0.003 and figures["corner_recall"] == 1.0 and figures["corner_precision"] > 0.8
    assert figures["area_error"] < 0.005 and figures["area_within"] == 1.0


def test_what_is_in_doubt_is_in_the_interval_of_an_area(furnished):
    """The fronts that were taken for walls or furniture count with their probabilities, beside the standard deviations of the walls."""
    _, building = furnished
    assert len(building.doubts) > 4 and set(building.doubts[:, 0]) <= set(range(len(building.areas_m2)))
    for room in range(len(building.areas_m2)):
        low, high = area_interval(building, room)
        assert low <= building.areas_m2[room] <= high
        assert area_sigma(building, room) >= np.sqrt(building.area_variance[room])
    certain = replace(building, doubts=np.empty((0, 3)))
    half = 1.96 * np.sqrt(building.area_variance[0])
    assert area_interval(certain, 0) == pytest.approx(building.areas_m2[0] + np.array([-half, half]), rel=1e-5)
    likely, hardly = (replace(building, doubts=np.array([[0.0, 2.0, p]])) for p in (0.3, 0.01))
    assert area_interval(likely, 0)[1] == pytest.approx(building.areas_m2[0] + 2.0, abs=2.0 * half)
    assert area_interval(hardly, 0)[1] < building.areas_m2[0] + 1.5 * half
    assert area_sigma(likely, 0) == pytest.approx(np.hypot(half / 1.96, 2.0 * np.sqrt(0.3 * 0.7)))


@pytest.mark.parametrize(
    ("height_m", "over", "prior", "low", "high"),
    [
        (2.6, False, 0.25, 0.99, 1.0),  # no furniture is so high
        (2.0, False, 0.25, 0.2, 0.4),  # a wall is seen behind it
        (2.4, False, 0.25, 0.6, 0.8),  # but hardly any is so high
        (2.0, False, 0.75, 0.7, 0.9),  # nothing is seen behind it
        (2.4, True, 0.75, 0.0, 0.35),  # views look over it
    ],
)
def test_a_front_is_a_wall_with_a_probability(height_m, over, prior, low, high):
    assert low <= wall_probability(Stretch(0, 20, height_m, over), 2.5, prior) <= high


def test_below_a_low_ceiling_furniture_is_low():
    """Of 1.9 m: furniture ends at 1.7 m."""
    assert wall_probability(Stretch(0, 20, 1.8, False), 1.7, 0.25) == 1.0
    assert 0.2 < wall_probability(Stretch(0, 20, 1.4, False), 1.7, 0.25) < 0.3


def test_what_no_view_shows_within_a_room_is_inside_and_within_a_wall_is_not():
    polygons = [shapely.box(0, 0, 4, 1), shapely.box(0, 1, 1, 2), shapely.box(1, 1, 4, 2), shapely.box(0, 2, 4, 2.1), shapely.box(0, 2.1, 4, 4)]
    edges = [(0, 1, 0.0, 1.0), (0, 2, 0.0, 3.0), (1, 2, 0.0, 1.0), (1, 3, 0.0, 1.0), (2, 3, 1.0, 3.0), (3, 4, 1.0, 4.0)]
    free, in_wall = np.array([1.0, 0.1, 1.0, 0.1, 1.0]), np.array([False, False, False, True, False])
    assert inside_cells(Cells(polygons, free, edges, in_wall)).tolist() == [True, True, True, False, True]
    assert inside_cells(Cells(polygons, free, edges, np.zeros(5, np.bool_))).tolist() == [True, True, True, True, True]
    more = [*edges, (0, 5, 0.0, 1.0), (2, 5, 0.0, 1.0)]
    unseen = Cells([*polygons, shapely.box(4, 0, 7, 2)], np.append(free, 0.2), more, np.append(in_wall, False))
    assert not inside_cells(unseen)[5]  # nobody overlooks 6 m² of a room


@pytest.mark.parametrize(("rooms", "passed", "niche"), [((0, -1), -0.5, True), ((0, -1), -1.5, False), ((-1, 0), 1.5, False), ((0, 1), -0.5, False)])
def test_what_no_ray_goes_on_behind_is_a_niche(rooms, passed, niche):
    """A wall 10 cm thick along the x axis, with a stretch from 1 m to 2 m that rays cross as far as `passed` m in y."""
    levels = np.zeros((80, 80), np.uint32)
    low, high = sorted(round((2.0 + y) / CELL_M) for y in (0.0, passed))
    levels[low:high, 20:40] = 1  # the origin is at (0, -2)
    space = FreeSpace(np.array([0.0, -2.0]), levels, np.zeros((80, 80), np.bool_), np.zeros((80, 80), np.bool_))
    edge = Edge(np.array([0.0, 1.0]), 0.0, None, np.array([0.0, 0.0]), np.array([4.0, 0.0]))
    wall = WallPlan(edge, (0.0, 4.0), 0.1, 0.01, [])
    opening = OpeningPlan(0, (1.0, 2.0), (0.0, 2.0), (0.01,) * 4, "passage", rooms, np.empty(0, np.int32))
    assert is_niche(opening, wall, space) is niche


def test_a_benchmark_that_was_stopped_goes_on(tmp_path, monkeypatch):
    began = []

    def measure(words: list[str], out) -> None:
        began.append(out.name)
        out.mkdir()
        (out / "timing.json").write_text("{}")

    monkeypatch.setattr("trihedron.tools.benchmark.measure", measure)
    (tmp_path / "flat.kinect.1.unfinished").mkdir()
    for _ in range(2):
        assert [building_benchmark._track_scene("flat", "kinect", seed, 15.0, tmp_path / f"flat.kinect.{seed}").name for seed in range(2)] == [
            "flat.kinect.0", "flat.kinect.1"
        ]  # fmt: skip
    assert began == ["flat.kinect.0.unfinished", "flat.kinect.1.unfinished"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flat.kinect.0", "flat.kinect.1"]


def test_the_benchmark_makes_plans_at_true_poses(capsys):
    assert building_benchmark.main(["--scenes", "offices", "--sensors", "kinect", "--seeds", "1", "--fps", "5", "--true-poses"]) == 0
    first, second = capsys.readouterr().out.strip().split("\n\n")
    offices = dict(zip(building_benchmark.HEADER, first.splitlines()[1].split()))
    assert (
        offices["scene"] == "offices" and offices["recall"] == offices["precision"] == offices["doors"] == "1.00" and float(offices["wall cm"]) < 0.5
    )
    assert offices["frame ms"] == "-"
    published = dict(zip(building_benchmark.PUBLISHED_HEADER, second.splitlines()[1].split()))
    assert published["room F1"] == published["corner F1"] == "1.000" and published["false"] == "0"


def test_a_preview_is_a_plan_of_some_views(walk, offices):
    plugin = plugin_class("building", "manhattan_layout")()
    state = plugin.start()
    for frame, planes, pose in walk[1]:
        state = plugin.add(state, frame, planes, None, pose, None)
    views = len(state.views)
    preview = plugin.preview(state)
    assert len(state.views) == views > 60
    assert len(preview.areas_m2) == 3 and preview.areas_m2.sum() == pytest.approx(offices["manhattan_layout"].areas_m2.sum(), rel=0.05)


def test_a_plan_is_made_of_views_that_are_apart(walk):
    """Keyframes every 5 cm: of 300 those that are 25 cm apart; of 100 a quarter of that, 7 cm at least; of fewer all."""
    plugin, (frame, planes, pose) = plugin_class("building", "manhattan_layout")(), walk[1][0]
    state, map = plugin.start(), empty_map(0, 0, 32, 32, 16)
    for index in range(300):
        T = pose.T_world_camera.copy()
        T[0, 3] += 0.05001 * index
        map = add_keyframe(map, pose_at(index, T), frame.camera)[0]
        state = plugin.add(state, replace(frame, index=index), planes, None, pose_at(index, T), map)
    counts = {}
    for count in (300, 100, 50, 20):
        some = replace(state, views=state.views[:count], covariances=state.covariances[:count])
        counts[count] = [view.index for view, _ in spread_views(some)][:3]
    assert len(state.views) == 300 and counts == {300: [0, 5, 10], 100: [0, 2, 4], 50: [0, 1, 2], 20: [0, 1, 2]}


@pytest.mark.slow
def test_slam_gives_the_plan_so_far():
    room = Synthetic(length=4, width=160, height=120)
    camera, plans = room(0).camera, []
    with th.Slam(camera, outputs=["trajectory", "building"]) as slam:
        for k in range(4):
            frame = room(k)
            slam.track(frame.color, frame.depth_m, 0.1 * (k + 1))
            plans.append(slam.building(max_age_s=0.25))
        assert plans[0] is plans[1] is plans[2] is not plans[3] and plans[3].storeys
        assert slam.building() is plans[3] is not slam.building(max_age_s=0.0)
    with th.Slam(camera, outputs=["trajectory"]) as slam, pytest.raises(TrihedronError) as error:
        slam.building()
    assert str(error.value) == 'outputs: has no building, so none is made; give outputs=["trajectory", "building"]'


def test_viewers_get_a_layer(offices):
    messages = dict(TopicView().messages(offices["manhattan_layout"]))
    (entity,) = messages["/view/building"].entities
    assert entity.frame_id == "world" and len(entity.triangles) >= 2


def test_a_building_is_drawn_by_its_slot_and_other_values_by_none(offices):
    found = drawing_of(offices["manhattan_layout"])
    assert {solid.name for solid in found.solids} >= {"0/floor", "0/wall"} and not any("ceiling" in solid.name for solid in found.solids)
    assert [outline.name for outline in found.outlines] == [f"room_{k}" for k in range(len(offices["manhattan_layout"].areas_m2))]
    assert all(np.array_equal(outline.corners_m[0], outline.corners_m[-1]) for outline in found.outlines)
    assert drawing_of(pose_at(0, np.eye(4))) == Drawing()


def flat(depth: np.ndarray, index: int = 0) -> tuple[Frame, Planes, Pose]:
    """A frame of a depth image (120, 160), level, at the origin."""
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    frame = Frame(index, index, np.zeros((120, 160, 3), np.uint8), depth.astype(np.float32), camera)
    return frame, planes_of(frame), pose_at(index, np.eye(4))


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_plan_of_next_to_nothing_says_so(name):
    assert folded(name, []).note == "no plane was seen"
    assert folded(name, [flat(np.zeros((120, 160)))]).note == "no plane was seen"
    wall = folded(name, [flat(np.full((120, 160), 2.0))])
    assert wall.note == "no floor was seen; no ceiling was seen; 1 wall seen, which bounds no room"
    assert len(wall.areas_m2) == 0 and "1 wall seen" in floorplan_svg(wall)
    assert len(wall.walls_m) == 1 and np.linalg.norm(np.diff(wall.walls_m[0], axis=0)) == pytest.approx(2.44, abs=0.06)  # all that is in view


def test_a_crossed_stretch_is_no_opening_where_the_wall_was_read():
    wall = np.arange(0.0, 4.0, 0.01)
    assert widest_gap(1.0, 2.0, wall) is None  # rays go through by their noise
    door = wall[(wall < 1.2) | (wall > 2.1)]
    assert widest_gap(1.0, 2.6, door) == pytest.approx((1.2, 2.1), abs=0.06)
    assert widest_gap(1.2, 2.1, np.empty(0)) == pytest.approx((1.2, 2.1))


def test_a_jamb_that_was_hardly_read_does_not_close_an_opening():
    beside = np.concatenate([np.arange(0.0, 1.2, 0.001), np.full(40, 2.15)])
    assert fit_jambs(1.2, 1.95, beside)[:2] == pytest.approx((1.2, 1.95), abs=0.02)


def test_a_wall_ends_with_its_readings_where_nothing_bounds_the_room():
    count = np.zeros((20, LEVELS), np.int32)
    count[:12, 5] = 3  # 0.6 m of 1 m
    face = Face(np.array([0.0, 1.0]), 0.0, 0.0, count, count.any(axis=1), np.empty(0, np.int64))
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    normals = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
    ring = [Edge(n, float(p @ n), face if k == 0 else None, p, q) for k, (n, p, q) in enumerate(zip(normals, corners, np.roll(corners, -1, axis=0)))]
    loop = end_at_readings(ring, [face])
    intersect_edges(loop)
    assert [edge.face is face for edge in loop] == [True, False, False, False, False]
    assert np.array([edge.begin for edge in loop]) == pytest.approx(np.insert(corners, 1, [0.6, 0.0], axis=0))
    behind = Face(np.array([1.0, 0.0]), 1.1, -1.5, np.ones((40, LEVELS), np.int32), np.ones(40, np.bool_), np.empty(0, np.int64))
    ring[0] = Edge(normals[0], 0.0, face, corners[0], corners[1])
    assert len(end_at_readings(ring, [face, behind])) == 4  # the wall there was seen from behind


NO_EVIDENCE = Evidence(np.eye(4), [], [], np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0, np.int32))


def passed_space(where: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> FreeSpace:
    """Free space of 4 m by 4 m about the origin, of which rays passed what the condition on x and y says."""
    x, y = np.meshgrid(np.arange(-1.975, 2.0, 0.05), np.arange(-1.975, 2.0, 0.05))
    passed = where(x, y)
    return FreeSpace(np.full(2, -2.0), np.where(passed, 0xFFFFF, 0).astype(np.uint32), passed, np.zeros(passed.shape, np.bool_))


def column_and_wall(hidden: int) -> tuple[Face, Face]:
    """The front of a column of 0.35 m before a wall, of which that many cells beside the column's end were not read."""
    none = np.empty(0, np.int64)
    front = Face(np.array([0.0, 1.0]), 0.35, 0.0, np.ones((7, LEVELS), np.int32), np.ones(7, np.bool_), none)
    count = np.ones((120, LEVELS), np.int32)
    count[40 : 47 + hidden] = 0
    return front, Face(np.array([0.0, 1.0]), 0.0, -2.0, count, count.any(axis=1), none)


@pytest.mark.parametrize(("hidden", "sides"), [(0, [1, -1]), (12, [1, -1]), (30, [-1])])
def test_the_side_of_a_column_may_hide_some_of_the_wall_beside_it(hidden, sides):
    """The side is where the readings of the front end, if the wall behind is read at most a metre on."""
    found = jog_sides(list(column_and_wall(hidden)), NO_EVIDENCE, passed_space(lambda x, y: x < -9.0))
    assert sorted((int(side.normal[0]), round(side.offset_m, 6)) for side in found) == sorted((sign, 0.35 if sign > 0 else 0.0) for sign in sides)
    for side in found:  # from the front to the wall
        ends = side.start_m, side.start_m + 0.05 * len(side.count)
        assert sorted(abs(end) for end in ends) == pytest.approx([0.0, 0.35], abs=0.03)


@pytest.mark.parametrize("nook_m", [0.2, 0.4])
def test_rays_show_the_end_of_a_column_next_to_a_corner(nook_m):
    """Of the nook between the column and the corner nothing is read but the wall beside it; rays pass its mouth, not its ground."""
    front, wall = column_and_wall(20)
    wall = replace(wall, start_m=0.5, count=np.ones((30, LEVELS), np.int32), tall=np.ones(30, np.bool_))
    corner = wall_face((1.0, 0.0), -nook_m, [(-2.0, -0.1)])

    def passed(x, y, mouth_m=0.2):
        return (x > -nook_m) & (y > np.where(x < 0.0, 0.35 - mouth_m, np.where(x < 0.35, 0.35, 0.0)))

    space = passed_space(passed)
    faces = [front, wall, corner]
    assert [int(side.normal[0]) for side in jog_sides(faces, NO_EVIDENCE, passed_space(lambda x, y: passed(x, y, 0.0)))] == [1]
    sides = sorted(jog_sides(faces, NO_EVIDENCE, space), key=lambda side: side.normal[0])
    assert [int(side.normal[0]) for side in sides] == [-1, 1] and all(len(side.tall) == 7 for side in sides)
    cells = cells_of([*faces, *sides], space)
    inside = [polygon for polygon, kept in zip(cells.polygons, inside_cells(cells)) if kept]
    covered = [any(shapely.contains_xy(polygon, *place) for polygon in inside) for place in ((-0.1, 0.02), (0.2, 0.2), (0.2, 0.5), (0.6, 0.1))]
    assert covered == [True, False, True, True]  # nook, column, before it, beside it


def test_a_side_ends_where_rays_cross_its_line():
    """Of a column in front of a corner, one side is read: its front is square to that, and does not reach the wall of the corner."""
    side, corner = wall_face((1.0, 0.0), 0.35, [(-0.35, 0.0)]), wall_face((1.0, 0.0), -0.4, [(-2.0, 0.0)])
    space = passed_space(lambda x, y: (x > -0.4) & (y > np.where(x < 0.0, 0.0, 0.35)))
    (found,) = jog_sides([side, corner], NO_EVIDENCE, space)
    assert found.normal == pytest.approx([0.0, 1.0]) and found.offset_m == pytest.approx(0.35)
    assert found.start_m == pytest.approx(-0.1, abs=0.11) and found.start_m + 0.05 * len(found.tall) == pytest.approx(0.35)


def test_the_other_face_of_a_wall_is_not_that_of_a_curtain_before_it():
    """A curtain of 2.1 m, 13 cm before a wall that is seen beside it, and from the other room."""
    curtain, one = wall_face((0.0, 1.0), 0.13, [(0.0, 1.5)]), Stretch(0, 30, 2.1, False)
    wall, other = wall_face((0.0, 1.0), 0.0, [(1.5, 4.0)]), wall_face((0.0, -1.0), 0.1, [(-4.0, 0.0)])
    assert wall_prior(curtain, one, [curtain, wall, other], 0.13) < 0.5 < wall_prior(curtain, one, [curtain, other], None)


def wall_face(normal: tuple[float, float], offset_m: float, runs: list[tuple[float, float]]) -> Face:
    """A face that is read, floor to ceiling, between places along it."""
    start = runs[0][0]
    count = np.zeros((round((runs[-1][1] - start) / 0.05), LEVELS), np.int32)
    for begin, end in runs:
        count[round((begin - start) / 0.05) : round((end - start) / 0.05)] = 1
    return Face(np.array(normal), offset_m, start, count, count.any(axis=1), np.empty(0, np.int64))


def test_a_gap_between_walls_is_a_door_unless_a_corridor_goes_through():
    """A wall along x with a gap of 1.5 m; walls along y at both ends of the gap, that look into it, are those of a corridor."""
    wall = wall_face((0.0, 1.0), 0.0, [(-2.0, 0.0), (1.5, 4.0)])
    west, east = wall_face((1.0, 0.0), 0.0, [(-3.0, 3.0)]), wall_face((-1.0, 0.0), -1.5, [(-3.0, 3.0)])
    before, behind = wall_face((1.0, 0.0), 0.0, [(-3.0, 0.0)]), wall_face((-1.0, 0.0), -1.5, [(0.0, 3.0)])
    assert parting_columns(wall, [wall]).all() and parting_columns(wall, [wall, before, behind]).all()
    assert not parting_columns(wall, [wall, west, east])[41:69].any() and parting_columns(wall, [wall, west]).all()


def test_lines_that_are_nearly_one_part_no_room():
    """The two faces of a corner, fitted 2 mm apart."""
    none, normal = np.empty(0, np.int64), np.array([0.0, 1.0])
    faces = [
        Face(sign * normal, sign * offset, -0.5, np.ones((5, LEVELS), np.int32), np.ones(5, np.bool_), none)
        for sign, offset in ((1.0, 1.0), (-1.0, 1.00005))
    ]
    space = FreeSpace(np.zeros(2), np.full((40, 40), 7, np.uint32), np.ones((40, 40), np.bool_), np.zeros((40, 40), np.bool_))
    cells = cells_of(faces, space)
    assert len(cells.polygons) == 2 and len(components(cells, inside_cells(cells))) == 1


@pytest.mark.parametrize("turn_deg", [-2.0, 1.0])
def test_an_edge_turns_to_its_own_points(turn_deg):
    """A slanted wall that was taken to be 1° or 2° from where it is."""
    angle = np.radians(30.0)
    normal, along = np.array([np.cos(angle), np.sin(angle)]), np.array([np.sin(angle), -np.cos(angle)])
    points = 1.5 * normal + np.linspace(-1.0, 3.0, 50)[:, None] * along
    guess = angle + np.radians(turn_deg)
    edge = Edge(np.array([np.cos(guess), np.sin(guess)]), 0.0, None)
    edge.offset_m = float(np.mean(points @ edge.normal))
    for _ in range(2):
        rotate_edge(edge, points, np.linspace(1.0, 2.0, 50))
        edge.offset_m = float(np.mean(points @ edge.normal))
    assert edge.normal == pytest.approx(normal, abs=1e-4) and edge.offset_m == pytest.approx(1.5, abs=1e-4)


@pytest.mark.parametrize("middle", [(0.0, 0.0), (80.0, -30.0)])
def test_the_error_of_an_edge_is_relative_to_its_room(middle):
    """A room of 4 by 6 m wherever it is: 0.07 % of the distance from its middle by the scale of depth, and of drift what the edges do not share."""
    corners = np.array([[-2.0, -3.0], [2.0, -3.0], [2.0, 3.0], [-2.0, 3.0]]) + middle
    normals = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
    seen = Face(normals[0], 0.0, 0.0, np.ones((20, LEVELS), np.int32), np.ones(20, np.bool_), np.empty(0, np.int64))
    edges = [Edge(n, float(p @ n), seen, p, q, 0.002) for n, p, q in zip(normals, corners, np.roll(corners, -1, axis=0))]
    for edge, drift_m2 in zip(edges, (5e-6, 1e-6, 1e-6, 9e-6)):
        edge.drift_m2 = drift_m2
    make_relative(edges)
    expected = 0.002**2 + (0.0007 * np.array([3.0, 2.0, 3.0, 2.0])) ** 2 + [4e-6, 0.0, 0.0, 8e-6]
    assert np.square([edge.sigma_m for edge in edges]) == pytest.approx(expected, rel=1e-6)
    assert [edge.drift_m2 for edge in edges] == [1e-6] * 4


def test_a_room_seen_in_part_has_the_interval_of_its_area_on_its_plan(walk):
    building = folded("manhattan_layout", walk[1][:12])
    low, high = area_interval(building, 0)
    drawn = floorplan_svg(building)
    assert f"{building.areas_m2[0]:.2f} m² seen" in drawn and f"({low:.1f} to {high:.1f})" in drawn and "m² ±" not in drawn
    assert low < building.areas_m2[0] < building.areas_m2[0] + 1.0 < high  # it may go on where nothing bounds what was seen
    assert 0.3 < seen_share(building, 0) < 0.9
    (room,) = building_json(building)["rooms"]
    assert room["area_interval_m2"] == pytest.approx([low, high], abs=1e-4)
    assert room["area_sigma_m2"] == pytest.approx(area_sigma(building, 0), abs=1e-4)


def test_a_lost_camera_shows_nothing():
    frame, planes, pose = flat(np.full((120, 160), 2.0))
    assert folded("manhattan_layout", [(frame, planes, replace(pose, status="lost"))]).note == "no plane was seen"


def test_none_has_no_element():
    plugin = plugin_class("building", "none")()
    building = plugin.finish(plugin.add(plugin.start(), pose_at(7, np.eye(4))), None)
    assert (building.index, len(building.walls_m), building.note) == (7, 0, "no building was asked for")
