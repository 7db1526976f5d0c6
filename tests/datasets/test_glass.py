"""Mirrors and panes of glass in simulated views: where a mirror shows what, what is lost behind glass, and that other scenes have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trihedron.datasets.simulation.flats import random_flat
from trihedron.datasets.simulation.glass import look_through
from trihedron.datasets.simulation.glazed_flats import glazed_flat
from trihedron.datasets.simulation.raytracing import geometry_of
from trihedron.datasets.simulation.room import Glass, Pane, all_faces, furnished_room
from trihedron.datasets.simulation.shading import render
from trihedron.datasets.simulation.synthetic import Scene, Synthetic
from trihedron.datasets.simulation.textures import bake
from trihedron.pipeline.core.types import Camera

CAMERA = Camera(161, 121, 131.25, 131.25, 80.0, 60.0)
X, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def seen_through(kind: Glass, turn_deg: float = 0.0, noses: float = 2.0) -> tuple[np.ndarray, ...]:
    """Look from the middle of the room at a pane of 0.6 m before its south wall; returns RGB, depth and loss with it, and RGB and depth without."""
    room = furnished_room()
    geometry, atlas = geometry_of(room), bake(all_faces(room), True, 0, 1.0)
    T = np.eye(4)
    yaw = np.radians(turn_deg)
    ahead = np.array([np.sin(yaw), -np.cos(yaw), 0.0])  # south
    T[:3, :3] = np.stack([np.cross(-UP, ahead), -UP, ahead], axis=1)
    T[:3, 3] = [3.6, 0.05, 1.0] - noses * ahead
    color, depth, _, cosine = render(geometry, atlas, CAMERA, T)
    before = color.copy(), depth.copy()
    pane = Pane(kind, np.array([3.9, 0.05, 1.3]), -X, -UP, np.array([0.0, 1.0, 0.0]), (0.6, 0.6))
    lost = look_through((pane,), geometry, atlas, CAMERA, T, color, depth, cosine)
    return color, depth, lost, *before


def test_a_mirror_measures_the_way_to_what_it_reflects() -> None:
    color, depth, lost, plain, wall = seen_through(Glass.mirror)
    assert depth[60, 80] == pytest.approx(2.0 + 3.95, abs=0.2)  # to the mirror, and from there to the north wall or what stands there
    assert not lost.any()
    inside = np.zeros_like(lost)
    inside[42:79, 62:99] = True
    assert (depth[inside] > wall[inside] + 0.5).all() and (color[inside] != plain[inside]).any()
    inside[38:83, 58:103] = True
    assert np.array_equal(depth[~inside], wall[~inside]) and np.array_equal(color[~inside], plain[~inside])


def test_what_a_mirror_shows_is_what_a_camera_behind_it_would_see() -> None:
    room = furnished_room()
    geometry, atlas = geometry_of(room), bake(all_faces(room), True, 0, 1.0)
    color, depth, *_ = seen_through(Glass.mirror)
    T = np.eye(4)
    T[:3, :3] = np.stack([X, -UP, np.array([0.0, 1.0, 0.0])], axis=1)  # north
    T[:3, 3] = [3.6, 0.051, 1.0]
    behind = render(geometry, atlas, CAMERA, T)
    assert depth[60, 80] == pytest.approx(2.0 + behind[1][60, 80], abs=0.01)
    assert color[60, 80] == pytest.approx(behind[0][60, 80], abs=60)  # texels of another footprint


@pytest.mark.parametrize(("kind", "turn_deg", "is_lost"), [(Glass.inner, 0.0, False), (Glass.inner, 70.0, True), (Glass.outer, 0.0, True)])
def test_depth_behind_glass_is_lost_at_a_slant_and_outside(kind: Glass, turn_deg: float, is_lost: bool) -> None:
    color, depth, lost, plain, wall = seen_through(kind, turn_deg, 0.8)
    assert bool(lost[60, 80]) is is_lost and np.array_equal(depth, wall)
    assert (color[60, 80] < plain[60, 80]).all() and np.array_equal(color[~lost][-5:], plain[~lost][-5:])


def test_lost_depth_is_none_in_frames() -> None:
    number = next(k for k in range(30) if any(pane.kind is Glass.outer for pane in glazed_flat(k).room.panes))
    dataset = Synthetic(scene=Scene.glazed_flat, flat=number, fps=1.0, width=80, height=60)
    assert any((dataset(k).depth_m == 0.0).sum() > 100 for k in range(0, len(dataset), 3))


def test_a_glazed_flat_is_the_flat_of_its_number_and_its_windows_are_between_rooms() -> None:
    for number in range(6):
        flat, glazed = random_flat(number), glazed_flat(number)
        assert [p.tolist() for p in flat.room.planes] == [p.tolist() for p in glazed.room.planes] and flat.walk == replace(glazed.walk)
        assert {Glass.mirror} <= {pane.kind for pane in glazed.room.panes} and not flat.room.panes
        (plan,) = Synthetic(scene=Scene.glazed_flat, flat=number).plans()
        assert len(plan.windows) == sum(pane.kind is Glass.inner for pane in glazed.room.panes)
        again = glazed_flat(number)
        assert all(np.array_equal(a.origin, b.origin) and a.kind is b.kind for a, b in zip(glazed.room.panes, again.room.panes))
