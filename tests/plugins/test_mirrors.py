"""Mirrors in plans of buildings: on true poses, what a mirror shows is no room and no opening, and glass between rooms is a window."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.comparison.building_errors import plan_errors
from trihedron.datasets.simulation.glazed_flats import glazed_flat
from trihedron.datasets.simulation.room import Glass
from trihedron.datasets.simulation.synthetic import Scene, Synthetic
from trihedron.pipeline.core.types import OPENING_KINDS, Building, Camera
from trihedron.plugins.building import layout, openings
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import Face
from trihedron.plugins.building.free_space import FreeSpace
from trihedron.plugins.building.free_space_kernels import LEVELS
from trihedron.plugins.building.levels import Storey
from trihedron.plugins.building.mirrors import LEAST_WEIGHT, Mirror, mirrors_of, reflection_evidence, upright_readings, without_mirrors
from trihedron.plugins.shared.keyframe_views import KeyframeView

sys.path.insert(0, str(Path(__file__).parent))
from test_building import folded, planes_of, pose_at

FLAT = 3  # a window between rooms, and mirrors on wardrobes, in frames and from the floor up


@pytest.fixture(scope="module")
def walk() -> tuple[Synthetic, list]:
    dataset = Synthetic(scene=Scene.glazed_flat, flat=FLAT, seed=FLAT, fps=2.5, width=160, height=120, texture=False)
    truth = dataset.truth()
    frames = [dataset(k) for k in range(len(dataset))]
    return dataset, [(frame, planes_of(frame), pose_at(k, truth.poses[k])) for k, frame in enumerate(frames)]


def false_openings(plan: Building, dataset: Synthetic) -> int:
    """Count openings further than 0.3 m from each true one."""
    (truth,) = dataset.plans()
    true = [gap.middle for gap in (*truth.doorways, *truth.windows)]
    middles = []
    for wall, span in zip(plan.opening_walls, plan.spans_m):
        start, end = plan.walls_m[wall] @ plan.T_world_building[:2, :2].T + plan.T_world_building[:2, 3]
        middles.append(start + (end - start) / np.linalg.norm(end - start) * span.mean())
    return sum(all(np.linalg.norm(middle - other) > 0.3 for other in true) for middle in middles)


def test_what_mirrors_show_is_neither_a_room_nor_an_opening(walk, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, inputs = walk
    plan = folded("manhattan_layout", inputs)
    figures = plan_errors(plan, np.eye(4), dataset.plans())
    assert figures["room_recall"] == figures["room_precision"] == figures["door_recall"] == figures["door_precision"] == 1.0
    assert false_openings(plan, dataset) == 0
    monkeypatch.setattr(layout, "mirrors_of", lambda *inputs: [])
    monkeypatch.setattr(openings, "_is_mirror", lambda *inputs: False)
    assert false_openings(folded("manhattan_layout", inputs), dataset) >= 1


def test_glass_between_rooms_is_a_window(walk) -> None:
    dataset, inputs = walk
    (window,) = dataset.plans()[0].windows
    assert sum(pane.kind is Glass.inner for pane in glazed_flat(FLAT).room.panes) == 1
    plan = folded("manhattan_layout", inputs)
    (found,) = [k for k, kind in enumerate(plan.opening_kinds) if OPENING_KINDS[kind] == "window"]
    assert plan.opening_heights_m[found] == pytest.approx([window.bottom_m, window.height_m], abs=0.15)
    assert 0.45 < np.ptp(plan.spans_m[found]) < window.width_m + 0.05 and min(plan.opening_rooms[found]) >= 0  # its ends are seen at a slant


def test_a_ray_ends_at_the_mirror_that_turns_it_back() -> None:
    mirror = Mirror(np.array([0.0, 1.0]), 0.0, (-0.5, 0.5), (0.5, 1.5))  # faces north; along it is east
    eye, points = np.array([0.0, 2.0, 1.0]), np.array([[0.2, -2.0, 1.0], [3.0, -2.0, 1.0], [0.0, 1.0, 1.0], [0.0, -2.0, 3.0]])
    share, turned = mirror.crossing(eye, points)
    assert turned.tolist() == [True, False, False, False]  # beside it, before it, above it
    assert share[0] == pytest.approx(0.5)
    T = np.eye(4)
    T[:3, :3] = [[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]  # looks south
    T[:3, 3] = eye
    camera = Camera(3, 3, 1.0, 1.0, 1.0, 1.0)  # 45° between its rays
    view = KeyframeView(0, camera, np.full((3, 3), 4.0, np.float32), np.zeros((0, 0, 3), np.uint8), np.zeros((3, 3), np.uint8), np.zeros((0, 4)),
                        T, np.eye(4), -1, -1, 0)  # fmt: skip
    normals = np.tile([0.0, -1.0, 0.0], (4, 1))
    evidence = Evidence(np.eye(4), [view], [T], np.zeros((1, 3, 3)), points, normals, np.ones(4), np.ones(4), np.zeros(4, np.int32))
    moved = without_mirrors(evidence, [mirror])
    assert moved.points[0] == pytest.approx([0.1, 0.0, 1.0]) and moved.normals[0] == pytest.approx([0.0, 1.0, 0.0])
    assert np.array_equal(moved.points[1:], points[1:]) and np.array_equal(moved.normals[1:], normals[1:])
    depth = np.full((3, 3), 4.0)
    depth[1, 1] = 2.0
    assert moved.views[0].depth_m == pytest.approx(depth) and evidence.views[0].depth_m.min() == 4.0


def found_mirrors(inputs: list, monkeypatch: pytest.MonkeyPatch) -> tuple[Building, list[Mirror]]:
    """Return the plan, and the mirrors that were found for it."""
    found: list[Mirror] = []
    monkeypatch.setattr(layout, "mirrors_of", lambda *inputs: found.extend(mirrors_of(*inputs)) or found)
    return folded("manhattan_layout", inputs), found


def test_the_mirrored_door_of_a_wardrobe_is_a_mirror(walk, monkeypatch: pytest.MonkeyPatch) -> None:
    _, inputs = walk
    plan, found = found_mirrors(inputs, monkeypatch)
    doors = [pane for pane in glazed_flat(FLAT).room.panes if pane.kind is Glass.mirror and pane.size_m == pytest.approx((0.7, 1.85))]
    to_building = np.linalg.inv(plan.T_world_building)
    found_doors = 0
    for door in doors:
        middle = door.origin + 0.5 * (door.size_m[0] * door.u + door.size_m[1] * door.v)
        x, y = (to_building[:3, :3] @ middle + to_building[:3, 3])[:2]
        found_doors += any(
            abs(np.dot(mirror.normal, [x, y]) - mirror.offset_m) < 0.1
            and mirror.span[0] < x * mirror.normal[1] - y * mirror.normal[0] < mirror.span[1]
            for mirror in found
        )
    assert found_doors >= 1


def counted(*surfaces: tuple[int, tuple[float, float], float], free: int = 0) -> float:
    """Return the evidence for a mirror on the line y = 0; surfaces have a view, where on the plan they are, and where they look to in degrees, and
    are read 20 times at a height of 1.25 m. `free` are the levels that rays pass everywhere, as bits."""
    eyes = np.array([[0.0, 2.5, 1.25], [0.1, 2.5, 1.25], [5.0, 2.5, 1.25], [5.0, -0.5, 1.25]])  # two look at it, two walk round its end
    points = np.array([(x, y, 1.25) for _, (x, y), _ in surfaces for _ in range(80)])
    normals = np.array([(np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0) for *_, angle in surfaces for _ in range(80)])
    poses = [np.eye(4) for _ in eyes]
    for T, eye in zip(poses, eyes):
        T[:3, 3] = eye
    rows = np.repeat(np.array([view for view, *_ in surfaces], np.int32), 80)
    evidence = Evidence(np.eye(4), [], poses, np.zeros((4, 3, 3)), points, normals, np.ones(len(points)), np.ones(len(points)), rows)
    count = np.zeros((40, LEVELS), np.int32)
    count[[0, 1, 38, 39], :25] = 5  # read at both ends
    face = Face(np.array([0.0, 1.0]), 0.0, -1.0, count, np.zeros(40, np.bool_), np.zeros(0, np.int64))
    space = FreeSpace(np.array([-5.0, -5.0]), np.full((200, 200), free, np.uint32), np.zeros((200, 200), np.bool_), np.zeros((200, 200), np.bool_))
    storey = Storey(0.0, 2.6, 2.6)
    return reflection_evidence(face, (-0.9, 0.9), (0.0, 2.0), 0.1, upright_readings(evidence, storey), space, storey)


EVERYWHERE = 0xFFFFFFFF
BEHIND = (0, (0.0, -2.0), 90.0), (1, (0.0, -2.0), 90.0)  # what two views read through the line
REFLECTION, REAL = (2, (0.0, 2.0), -90.0), (3, (0.0, -2.0), 90.0)


def test_a_reading_is_evidence_for_a_mirror_against_one_or_neither() -> None:
    assert counted(*BEHIND, REFLECTION) == LEAST_WEIGHT
    assert counted(*BEHIND, REAL) == counted(*BEHIND, free=EVERYWHERE) == -LEAST_WEIGHT
    assert counted(*BEHIND) == counted(*BEHIND, REFLECTION, REAL) == 0.0


def test_one_view_does_not_decide_alone() -> None:
    assert counted(BEHIND[0], REFLECTION) == LEAST_WEIGHT / 2.0
    assert counted(BEHIND[0], REAL) == -LEAST_WEIGHT / 2.0


def test_rays_past_a_thin_thing_or_over_its_top_do_not_contradict_its_reflection() -> None:
    leaf = (2, (0.0, 2.0), 90.0)  # read from its other side
    assert counted(*BEHIND, leaf, free=EVERYWHERE) == 0.0
    over = EVERYWHERE ^ ((1 << 12) - 1)  # at 1.2 m and above
    assert counted(*BEHIND, free=over) == 0.0 and counted(*BEHIND, free=over | 1 << 11) == -LEAST_WEIGHT


def test_rays_through_what_stands_behind_the_wall_show_a_mirror() -> None:
    curtain, own_face = (3, (0.0, -0.35), -90.0), (3, (0.0, -0.1), -90.0)
    assert counted(*BEHIND, REAL, curtain) == LEAST_WEIGHT
    assert counted(*BEHIND, REAL, own_face) == -LEAST_WEIGHT  # beside the opening


def test_walls_square_to_a_mirror_decide_only_where_nothing_that_faces_it_speaks_against() -> None:
    square = (0, (-0.95, -0.5), 0.0), (1, (-0.95, -0.5), 0.0)
    assert counted(*square, (2, (-0.95, 0.5), 0.0)) == LEAST_WEIGHT
    assert counted(*square, (2, (-0.95, 0.5), 0.0), *BEHIND, REAL) == 0.0
