"""The synthetic buildings: walks that stay clear of everything and come back, exact depth behind walls, offices that look the same."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely

from trihedron.datasets.simulation.buildings import Building
from trihedron.datasets.simulation.flats import random_flat, whole_floor
from trihedron.datasets.simulation.raytracing import geometry_of
from trihedron.datasets.simulation.room import all_faces
from trihedron.datasets.simulation.shading import render
from trihedron.datasets.simulation.synthetic import BUILDINGS, Scene, Synthetic
from trihedron.datasets.simulation.textures import bake
from trihedron.pipeline.core.lie import rotation_angle_deg
from trihedron.pipeline.core.types import Camera

sys.path.insert(0, str(Path(__file__).parent))
from test_synthetic_room import first_hit

CAMERA = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
WALKS = {  # scene -> least frames, and the length of the walk in metres
    Scene.corridor: (900, 45.6),
    Scene.offices: (1500, 43.8),
    Scene.rooms: (2000, 52.2),
}


@pytest.fixture(scope="module", params=list(WALKS), ids=lambda scene: scene.name)
def scene(request: pytest.FixtureRequest) -> tuple[Scene, Building]:
    return request.param, BUILDINGS[request.param]()


def clearance_m(building: Building, positions: np.ndarray) -> float:
    """From the nearest surface, boxes around what is round."""
    room = building.room
    nearest = [(positions @ room.planes[:, :3].T + room.planes[:, 3]).min()]
    for solid in room.solids:
        beyond = np.maximum(np.abs((positions - solid.centre) @ solid.R_world_solid) - solid.half, 0.0)
        nearest.append(np.linalg.norm(beyond, axis=1).min())
    return float(min(nearest))


def test_the_walk_is_clear_of_everything_and_ends_where_it_began(scene: tuple[Scene, Building]) -> None:
    name, building = scene
    least, length_m = WALKS[name]
    assert building.walk.length_m == pytest.approx(length_m, abs=0.05)
    assert len(Synthetic(scene=name)) == round(building.walk.duration_s * 30) >= least
    for seed in range(2):
        poses = np.array([building.walk.pose(seed, i / 30) for i in range(0, len(Synthetic(scene=name)) + 1)])
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        turning = [rotation_angle_deg(a[:3, :3].T @ b[:3, :3]) * 30 for a, b in pairwise(poses)]
        assert clearance_m(building, poses[:, :3, 3]) > 0.4
        assert 0.5 < steps.max() * 30 < 1.2 and max(turning) < 65.0
        assert steps.sum() == pytest.approx(length_m, rel=0.06)  # corners are rounded
        assert np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < 0.15


@pytest.mark.parametrize("number", range(0, 40, 3))
def test_a_flat_of_a_number_is_whole_and_its_walk_is_clear(number: int) -> None:
    """Every room is one and can be reached, and the walk leaves furniture alone."""
    dataset = Synthetic(scene=Scene.random_flat, flat=number)
    building, (plan,) = random_flat(number), dataset.plans()
    rooms = [shapely.Polygon(room[0], room[1:]) for room in plan.rooms]
    assert 3 <= len(rooms) <= 6 and len(plan.doorways) >= len(rooms) - 1
    places = np.array([building.walk.pose(0, t)[:2, 3] for t in np.linspace(0.0, building.walk.duration_s, 400)])
    assert all(shapely.contains_xy(room, *places.T).any() for room in rooms)
    poses = np.array([building.walk.pose(0, t)[:3, 3] for t in np.linspace(0.0, building.walk.duration_s, 400)])
    assert clearance_m(building, poses) > 0.1
    again = random_flat(number)
    assert again.walk == building.walk and len(again.room.solids) == len(building.room.solids)


def test_a_whole_floor_has_eight_rooms_on_a_corridor_and_two_upstairs() -> None:
    """A stairwell at the end of the corridor leads to a landing; the walk shows every room, and every storey for itself."""
    ground, upper = Synthetic(scene=Scene.whole_floor).plans()
    building = whole_floor()
    assert [(len(plan.rooms), len(plan.doorways)) for plan in (ground, upper)] == [(10, 9), (3, 3)]
    assert (ground.floor_m, ground.ceiling_m, upper.floor_m, upper.ceiling_m) == pytest.approx((0.0, 2.7, 3.0, 5.7))
    places = np.array([building.walk.pose(0, t)[:3, 3] for t in np.linspace(0.0, building.walk.duration_s, 1000)])
    assert building.walk.length_m == pytest.approx(261.8, abs=0.1) and clearance_m(building, places) > 0.1
    for plan in (ground, upper):
        there = places[np.abs(places[:, 2] - plan.floor_m - 1.45) < 0.2, :2]
        assert all(shapely.contains_xy(shapely.Polygon(room[0], room[1:]), *there.T).any() for room in plan.rooms)
    again = whole_floor()
    assert again.walk == building.walk and [s.centre.tolist() for s in again.room.solids] == [s.centre.tolist() for s in building.room.solids]


def test_a_number_is_for_flats_that_are_drawn_alone() -> None:
    with pytest.raises(ValueError, match="flat: only scene=random_flat and scene=glazed_flat have a number"):
        Synthetic(flat=3)


def test_walls_hide_what_is_behind_them(scene: tuple[Scene, Building]) -> None:
    """Depth is that of the nearest of all surfaces."""
    _, building = scene
    geometry, atlas = geometry_of(building.room), bake(all_faces(building.room), False, 0)
    rng = np.random.default_rng(0)
    for time_s in np.linspace(0.0, building.walk.duration_s, 6):
        pose = building.walk.pose(0, float(time_s))
        _, depth, _, _ = render(geometry, atlas, CAMERA, pose)
        for x, y in zip(rng.integers(0, 160, 12), rng.integers(0, 120, 12)):
            ray = pose[:3, :3] @ np.array([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0])
            assert depth[y, x] == pytest.approx(first_hit(building.room, pose[:3, 3], ray), abs=1e-9)


def test_frames_have_depth_and_none_beyond_the_sensor(scene: tuple[Scene, Building]) -> None:
    dataset = Synthetic(scene=scene[0], texture=False, width=160, height=120)
    for number in range(0, len(dataset), len(dataset) // 20):
        frame = dataset(number)
        assert frame is not None
        assert (frame.depth_m > 0.5).mean() > 0.7
        assert frame.depth_m.max() < 8.5
    truth = dataset.truth()
    assert truth is not None and len(truth) == len(dataset)
    np.testing.assert_array_equal(truth.poses[number], scene[1].walk.pose(0, number / 30))


@pytest.mark.parametrize(
    ("name", "place", "shift"), [(Scene.offices, (3.4, 2.8, 1.4), (6.8, 0.0, 0.0)), (Scene.storeys, (2.9, 4.2, 1.4), (0.0, 0.0, 3.0))]
)
def test_offices_and_storeys_cannot_be_told_apart(name: Scene, place: tuple[float, ...], shift: tuple[float, ...]) -> None:
    """The same view in both, but for the rounding of a few samples on edges."""
    room = BUILDINGS[name]().room
    geometry, atlas = geometry_of(room), bake(all_faces(room), True, 0, 0.1)
    pose = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])  # north
    pose[:3, 3] = place
    other = pose.copy()
    other[:3, 3] += shift
    (color, depth, _, _), (color2, depth2, _, _) = (render(geometry, atlas, CAMERA, T) for T in (pose, other))
    difference = np.abs(color.astype(int) - color2)
    assert (difference <= 1).mean() > 0.995 and difference.mean() < 0.05 and np.ptp(color) > 100
    np.testing.assert_allclose(depth, depth2, atol=1e-9)
