"""Corrections of a building by hand: kept when it is computed again, in all files, and one line for what a file has wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest
from omegaconf import OmegaConf
from two_rooms import two_rooms

import trihedron as th
from trihedron.pipeline.app.execute import metadata_of
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.registry import load_plugins, plugin_class
from trihedron.pipeline.core.types import Building
from trihedron.pipeline.record.codec import Decoder, Encoder
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.plugins.building.edits import apply_edits, missing_edits, read_edits
from trihedron.plugins.building.files import building_json, write_building
from trihedron.plugins.building.ifc import write_ifc
from trihedron.plugins.building.svg import floorplan_svg
from trihedron.tools import building as command

CURE = "correct it, or give a building.json that trihedron wrote"


def moved(building: Building) -> Building:
    """The same building computed again: 3 cm beside where it was, its walls and rooms in the opposite order."""
    back, rooms = np.arange(len(building.walls_m))[::-1], building.loops[::-1].copy()
    corners = np.concatenate([building.corners_m[a:b] for _, a, b in rooms])
    walls = np.concatenate([building.corner_walls[a:b] for _, a, b in rooms])
    return replace(
        building, walls_m=building.walls_m[back] + 0.03, thickness_m=building.thickness_m[back], wall_covariance=building.wall_covariance[back],
        unseen=np.array([[4.0, 0.5, 1.0]]), loops=np.array([[0, 0, 4], [1, 4, 8]], np.int32), corners_m=corners + 0.03,
        corner_walls=(6 - walls).astype(np.int32), opening_walls=np.array([6], np.int32), opening_rooms=np.array([[1, 0]], np.int32),
    )  # fmt: skip


def edited(tmp_path, building: Building, change) -> str:
    """The path of the building's file after a change of its object."""
    found = json.loads(json.dumps(building_json(building)))
    change(found)
    (tmp_path / "edited.json").write_text(json.dumps(found))
    return str(tmp_path / "edited.json")


def name_all(found) -> None:
    found["rooms"][0] |= {"name": "Küche & Bad", "use": "kitchen"}
    found["walls"][0]["name"] = "middle"
    found["openings"][0] |= {"name": "Sesame", "kind": "passage"}


def test_a_file_as_it_was_written_corrects_nothing(tmp_path):
    building = two_rooms()
    path = edited(tmp_path, building, lambda found: None)
    assert read_edits(path) == () and read_edits("") == () and apply_edits(building, ()) is building
    assert building_json(building)["edits"] == [] and [room["id"] for room in building_json(building)["rooms"]] == ["room-0", "room-1"]


def test_names_uses_and_kinds_are_kept_when_numbers_change(tmp_path):
    again = apply_edits(moved(two_rooms()), read_edits(edited(tmp_path, two_rooms(), name_all)))
    plan = th.Building(again)
    assert [(room.name, room.use) for room in plan.rooms] == [("", ""), ("Küche & Bad", "kitchen")]
    assert [wall.name for wall in plan.walls] == ["", "", "", "", "", "", "middle"]
    assert [(opening.name, opening.kind) for opening in plan.openings] == [("Sesame", "passage")]
    assert missing_edits(again) == []


def test_names_are_in_every_file(tmp_path):
    building = apply_edits(two_rooms(), read_edits(edited(tmp_path, two_rooms(), name_all)))
    write_building(tmp_path, building)
    read = json.loads((tmp_path / "building.json").read_text())
    assert (read["rooms"][0]["name"], read["rooms"][0]["use"], read["openings"][0]["id"]) == ("Küche & Bad", "kitchen", "passage-0")
    svg = ElementTree.fromstring((tmp_path / "floorplan.svg").read_text())
    groups = {group.get("id"): group[0].text for group in svg.iter("{http://www.w3.org/2000/svg}g")}
    assert groups["room-0"] == "Küche & Bad – kitchen" and groups["wall-0"] == "middle" and groups["passage-0"] == "Sesame"
    texts = {text.dxf.text for text in ezdxf.readfile(tmp_path / "floorplan.dxf").modelspace().query("TEXT")}
    assert "Küche & Bad – kitchen: 12.00 ± 0.01 m²" in texts and "Sesame" in texts
    import ifcopenshell

    write_ifc(tmp_path / "model.ifc", building)
    model = ifcopenshell.open(tmp_path / "model.ifc")
    assert [(space.LongName, space.ObjectType) for space in model.by_type("IfcSpace")] == [("Küche & Bad", "kitchen"), ("room 1", None)]
    assert model.by_type("IfcWall")[0].Name == "middle" and model.by_type("IfcOpeningElement")[0].Name == "Sesame"


def test_ids_of_the_plan_are_those_of_the_file():
    building = two_rooms()
    read, svg = building_json(building), floorplan_svg(building)
    ids = [element["id"] for key in ("walls", "rooms", "openings") for element in read[key]]
    found = [group.get("id") for group in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}g")]
    assert sorted(found) == sorted(ids) and len(set(ids)) == len(ids) == 10 and "door-0" in ids


def test_a_deleted_wall_goes_with_its_door_and_opens_the_rooms(tmp_path):
    path = edited(tmp_path, two_rooms(), lambda found: found["walls"][0].update(deleted=True))
    again = apply_edits(moved(two_rooms()), read_edits(path))
    assert len(again.walls_m) == 6 and len(again.spans_m) == 0 and not again.closed.any()
    assert again.corner_walls.tolist() == [2, 1, 0, -1, 5, -1, 4, 3] and again.unseen.tolist() == [[4.0, 0.5, 1.0]]
    assert sorted(again.support[again.support[:, 0] == 1, 1].tolist()) == list(range(6)) and 3 not in again.support[:, 0]
    rooms = apply_edits(moved(two_rooms()), read_edits(edited(tmp_path, two_rooms(), lambda found: found["rooms"][0].update(deleted=True))))
    assert rooms.areas_m2.tolist() == [12.0] and rooms.opening_rooms.tolist() == [[-1, 0]] and rooms.loops.tolist() == [[0, 0, 4]]


def test_what_was_deleted_stays_so_in_the_files_that_follow(tmp_path):
    """The file that a correction led to is a file of corrections too."""
    first = edited(tmp_path, two_rooms(), lambda found: (found["openings"][0].update(deleted=True), found["rooms"][1].update(name="Study")))
    building = apply_edits(two_rooms(), read_edits(first))
    for again in (moved(two_rooms()), two_rooms(), building):  # the last is as recorded: corrected already
        building = apply_edits(again, read_edits(edited(tmp_path, building, lambda found: None)))
        assert len(building.spans_m) == 0 and "Study" in [room.name for room in th.Building(building).rooms] and missing_edits(building) == []
    nameless = apply_edits(two_rooms(), read_edits(edited(tmp_path, building, lambda found: [room.update(name="") for room in found["rooms"]])))
    assert [room.name for room in th.Building(nameless).rooms] == ["", ""] and len(nameless.spans_m) == 0


def test_a_door_is_added_and_may_be_taken_back(tmp_path):
    door = {"kind": "door", "wall": 5, "span_m": [1.0, 1.9], "heights_m": [0.0, 2.0], "name": "Front"}
    building = apply_edits(moved(two_rooms()), read_edits(edited(tmp_path, two_rooms(), lambda found: found["openings"].append(door))))
    front = next(opening for opening in th.Building(building).openings if opening.name == "Front")
    assert front.kind == "door" and front.wall == 1 and set(front.rooms) == {0, None} and np.isnan(front.width_m.sigma)
    assert front.width_m.value == pytest.approx(0.9) and front.middle == pytest.approx([8.16, 1.48, 1.0], abs=0.1)
    write_building(tmp_path, building)
    again = apply_edits(two_rooms(), read_edits(str(tmp_path / "building.json")))
    assert [opening.name for opening in th.Building(again).openings] == ["", "Front"]
    gone = apply_edits(two_rooms(), read_edits(edited(tmp_path, again, lambda found: found["openings"][1].update(deleted=True))))
    assert len(gone.spans_m) == 1 and missing_edits(gone) == []


def test_a_correction_of_nothing_is_said(tmp_path):
    def change(found):
        found["openings"][0]["name"] = "Sesame"
        found["openings"].append({"kind": "window", "wall": 4, "span_m": [1.0, 1.5], "heights_m": [1.0, 2.0]})

    edits = read_edits(edited(tmp_path, two_rooms(), change))
    other = apply_edits(replace(two_rooms(), walls_m=two_rooms().walls_m + 20.0), edits)
    assert write_building(tmp_path, other)[1:] == [
        "building: the opening at (4.05, 1.45) m of storey 0 that was named 'Sesame' by hand: no opening of the plan is there; "
        "the correction is kept for the next",
        "building: the opening at (5.35, -0.03) m of storey 0 that was added by hand: no wall of the plan is there; "
        "the correction is kept for the next",
    ]
    back = apply_edits(two_rooms(), read_edits(str(tmp_path / "building.json")))
    assert missing_edits(back) == [] and [opening.name for opening in th.Building(back).openings] == ["Sesame", ""]


def test_corrections_are_recorded(tmp_path):
    building = apply_edits(two_rooms(), read_edits(edited(tmp_path, two_rooms(), name_all)))
    read = Decoder("here").decode(Encoder().encode(building))
    assert th.Building(read).rooms[0].name == "Küche & Bad"
    with pytest.raises(TrihedronError) as error:
        floorplan_svg(replace(building, edits='[{"element": "roof"}]'))
    assert str(error.value) == f'building.edits[0].element: is to be one of wall, room, opening, not "roof"; {CURE}'


TEXT = "a text of at most 200 printable characters"
DELETE = 'mark an element as "deleted": true instead of removing it'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda found: found["rooms"][0].update(name=3), f": rooms[0].name: is to be {TEXT}, not 3; {CURE}"),
        (lambda found: found["rooms"][0].update(use="a\nb"), f': rooms[0].use: is to be {TEXT}, not "a\\nb"; {CURE}'),
        (lambda found: found["walls"][1].update(deleted="yes"), f': walls[1].deleted: is to be true or false, not "yes"; {CURE}'),
        (lambda found: found["openings"][0].update(kind="gate"), f': openings[0].kind: is to be one of door, passage, window, not "gate"; {CURE}'),
        (lambda found: found["openings"].append({"kind": "door", "wall": 7}), None),
        (lambda found: found["walls"][2].update(start=[1e999, 0], name="x"), None),
        (lambda found: found.update(walls=7), f": walls: is not a list of objects; {CURE}"),
        (lambda found: found.update(edits=[{"element": "wall"}]), f": edits[0].outline: is to be numbers as trihedron writes them, not null; {CURE}"),
        (lambda found: found["walls"].pop(2), f": walls[2]: has not the id wall-2; {DELETE}"),
        (lambda found: found["openings"].pop(), f": has 0 openings with an id, and had 1; {DELETE}"),
        (lambda found: found["rooms"].append({}), ": rooms[2]: has no id; only openings can be added"),
        (lambda found: found["rooms"][0].update(nme="Hall"), ": rooms[0]: has 'nme', which is not read; did you mean 'name'?"),
        (lambda found: found["walls"][1].update(Delete=True), ": walls[1]: has 'Delete', which is not read; did you mean 'deleted'?"),
        (lambda found: found.pop("count"), ": is no building.json with ids; write it again with: trihedron building RUN"),
    ],
)  # fmt: skip
def test_a_mistake_in_the_file_is_one_line(tmp_path, change, message):
    path = edited(tmp_path, two_rooms(), change)
    with pytest.raises(TrihedronError) as error:
        read_edits(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value) and str(error.value).endswith(message or CURE)


def test_a_file_that_is_none_is_one_line(tmp_path):
    path = tmp_path / "edits.json"
    for text, cause in (("{", "is not JSON (JSONDecodeError)"), ("[" * 100_000, "is not JSON (RecursionError)")):
        path.write_text(text)
        with pytest.raises(TrihedronError) as error:
            read_edits(str(path))
        assert str(error.value) == f"{path}: {cause}; {CURE}"
    path.write_text("{}")
    with pytest.raises(TrihedronError) as error:
        read_edits(str(path), "0" * 64)
    cause = f"{path} has the SHA-256 44136fa355b3…, and 000000000000… is required"
    assert str(error.value) == f"building.edits: {cause}; give the file of the recorded run, or building.edits_sha256= to take another"
    with pytest.raises(TrihedronError) as error:
        read_edits(str(tmp_path / "nowhere"))
    assert str(error.value) == f"{tmp_path}/nowhere: cannot be read (No such file or directory); check the path and its permissions"


def test_the_command_keeps_corrections_and_overwrites_none(tmp_path, capsys):
    run, out = tmp_path / "run.mcap", tmp_path / "plan"
    writer = RecordingWriter(run, {"overrides": "[]", "config": "seed: 0"})
    writer.write("building", two_rooms())
    writer.close()
    assert command.main([str(run), "--out", str(out)]) == 0 == command.main([str(run), "--out", str(out)])
    found = json.loads((out / "building.json").read_text())
    name_all(found)
    (out / "building.json").write_text(json.dumps(found))
    with pytest.raises(TrihedronError) as error:
        command.main([str(run), "--out", str(out)])
    path = out / "building.json"
    assert str(error.value) == f"{path}: holds corrections by hand, which would be lost; give --edits {path}, or another --out FOLDER"
    for _ in range(2):
        assert command.main([str(run), "--out", str(out), "--edits", str(path)]) == 0
        assert json.loads(path.read_text())["rooms"][0]["name"] == "Küche & Bad"
    capsys.readouterr()
    path.write_text("{,")
    with pytest.raises(TrihedronError) as error:
        command.main([str(run), "--out", str(out)])
    assert str(error.value) == f"{path}: is not JSON (JSONDecodeError); {CURE}" and path.read_text() == "{,"


@pytest.mark.parametrize("name", ["manhattan_layout", "atlanta_layout", "cells"])
def test_a_stage_reads_its_corrections_before_the_first_frame(tmp_path, name):
    load_plugins()
    plugin = plugin_class("building", name)
    wrong, right = plugin(edits=str(tmp_path / "nowhere")), plugin(edits=edited(tmp_path, two_rooms(), name_all))
    with pytest.raises(TrihedronError, match="nowhere: cannot be read"):
        wrong.start()
    building = right.finish(right.start(), None)
    assert building.note == "no plane was seen" and len(missing_edits(building)) == 3


def test_a_replay_demands_the_same_file(tmp_path):
    path = edited(tmp_path, two_rooms(), name_all)
    config = OmegaConf.create({"building": {"edits": path, "edits_sha256": ""}})
    recorded = OmegaConf.create(metadata_of(config, [])["config"])
    assert len(read_edits(path, recorded.building.edits_sha256)) == 3
    edited(tmp_path, two_rooms(), lambda found: None)
    with pytest.raises(TrihedronError, match="is required; give the file of the recorded run"):
        read_edits(path, recorded.building.edits_sha256)
