"""What a surface remembers: how much, where it hangs, how certain it is, and what becomes of planes that the map knows ill."""

import sys
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.registry import load_plugins, plugin_class, plugins_of
from trihedron.pipeline.core.types import Camera
from trihedron.plugins.mapping.insertion import add_keyframe
from trihedron.plugins.mapping.landmarks import empty_map
from trihedron.plugins.shared.keyframe_views import readings
from trihedron.plugins.surface.fused_volume import final_volume
from trihedron.plugins.surface.half_edges import opposite_half_edges
from trihedron.plugins.surface.measured_noise import with_measured_noise
from trihedron.plugins.surface.planar_segmentation import PlanarOptions, planar_labels

sys.path.insert(0, str(Path(__file__).parent))
from surface_world import CAMERA, FLOOR, fold, off_truth, seen, walk

load_plugins()
SURFACES = tuple(name for name in plugins_of("surface") if name != "none")


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name == "open3d_poisson" else ()) for name in SURFACES])
def test_what_was_gathered_follows_the_final_keyframes(name):
    """Poses said 5 cm off, hung on a keyframe that the map puts right in the end."""
    shift = np.array([0.05, 0.0, 0.0])
    map = empty_map(0, 0, 32, 32, 32)
    inputs = []
    for k, T in enumerate(walk(4)):
        frame, planes, rotation, pose = seen(k, T)
        if k == 0:
            map, _ = add_keyframe(map, pose, CAMERA)
        wrong = pose_matrix(T[:3, :3], T[:3, 3] + shift)
        inputs.append((frame, planes, rotation, replace(pose, T_world_camera=wrong, reference=0, T_reference_camera=np.linalg.inv(walk(1)[0]) @ T)))
    surface = fold(plugin_class("surface", name)(view_width=160), inputs, map)
    assert np.median(off_truth(surface)) < 0.01
    unmoved = fold(plugin_class("surface", name)(view_width=160), inputs)
    assert off_truth(unmoved).max() > 0.04


def held_bytes(value):
    """Bytes of all arrays that a value, its lists and its fields hold."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, (list, tuple)):
        return sum(held_bytes(item) for item in value)
    if isinstance(value, dict):
        return held_bytes(list(value.values()))
    return sum(held_bytes(getattr(value, field.name)) for field in fields(value)) if is_dataclass(value) else 0


@pytest.mark.parametrize("name", SURFACES)
def test_memory_is_bounded_by_the_room_not_by_the_sequence(name):
    """The walk again and again: a surface holds no more after the tenth time than after the fifth, and not twice what it held after the second."""
    plugin = plugin_class("surface", name)(view_width=160)
    state, held = plugin.start(), []
    for k in range(80):
        state = plugin.add(state, *seen(k, walk()[k % 8]), None)
        held.append(held_bytes(state))
    assert held[-1] == held[39] < 2 * held[15] and 0 < len(state.views) <= 24


def test_the_volume_is_built_again_only_when_the_map_moved_a_view():
    """By more than `rebuild_m`; one that a loop moved by less stays as it was fused."""
    plugin = plugin_class("surface", "tsdf")(view_width=160)
    for moved_m, same in ((0.008, True), (0.012, False)):
        map, state = empty_map(0, 0, 32, 32, 32), plugin.start()
        for k, T in enumerate(walk(4)):
            frame, planes, rotation, pose = seen(k, T)
            if k == 0:
                there = pose_matrix(T[:3, :3], T[:3, 3] + [moved_m, 0.0, 0.0])
                map, _ = add_keyframe(map, replace(pose, T_world_camera=there), CAMERA)
            hung = replace(pose, reference=0, T_reference_camera=np.linalg.inv(walk(1)[0]) @ T)
            state = plugin.add(state, frame, planes, rotation, hung, None)
        assert (final_volume(plugin, state, map) is state.volume) == same


def test_planes_found_in_the_mesh_are_numbered_after_those_of_the_map_that_nobody_saw():
    """Two level squares of the mesh, one in a plane of the map, and a last plane of the map that is elsewhere."""
    x, y = np.meshgrid(0.05 * np.arange(20), 0.05 * np.arange(20))
    square = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    corner = (np.arange(19)[:, None] * 20 + np.arange(19)).ravel().astype(np.int32)
    half = np.concatenate([np.stack([corner, corner + 1, corner + 21], axis=1), np.stack([corner, corner + 21, corner + 20], axis=1)])
    vertices, triangles = np.concatenate([square, square + np.array([0.0, 0.0, 1.0])]), np.concatenate([half, half + 400]).astype(np.int32)
    known = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 5.0]])
    normals, flat = np.tile([0.0, 0.0, 1.0], (800, 1)), PlanarOptions()
    labels, planes = planar_labels(vertices, normals, triangles, opposite_half_edges(triangles), known, flat)
    assert set(labels[: len(half)]) == {0} and set(labels[len(half) :]) == {2}
    assert np.allclose(planes[2], [0.0, 0.0, 1.0, -1.0]) and np.allclose(planes[1], known[1])


def test_a_floor_that_was_mapped_twice_is_one_plane():
    """Planes 6 mm apart on average that cross in the middle of what they both describe."""
    x, y = np.meshgrid(0.05 * np.arange(40), 0.05 * np.arange(20))
    vertices = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    corner = (np.arange(19)[:, None] * 40 + np.arange(39)).ravel().astype(np.int32)
    triangles = np.concatenate([np.stack([corner, corner + 1, corner + 41], axis=1), np.stack([corner, corner + 41, corner + 40], axis=1)])
    tilted = np.array([[0.006, 0.0, 1.0, -0.009], [-0.006, 0.0, 1.0, 0.009]]) / np.sqrt(1.0 + 0.006**2)
    normals, flat = np.tile([0.0, 0.0, 1.0], (len(vertices), 1)), PlanarOptions()
    labels, planes = planar_labels(vertices, normals, triangles, opposite_half_edges(triangles), tilted, flat)
    assert len(set(labels)) == 1 and np.allclose(planes[labels[0]], [0.0, 0.0, 1.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(("noise_m", "near", "far"), [(0.0, 0.0, 0.1), (1.0, 0.85, 1.0)])
def test_a_frame_without_noise_is_known_by_its_planes(noise_m, near, far):
    """The camera says a Kinect's noise; the readings have `noise_m` of it. What is seen beyond 4.2 m is meshed where they have none."""
    kinect = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    frame, planes, *_ = seen(0, np.eye(4), ((0.0, 0.0, -1.0, 6.0), FLOOR), ball=False, camera=kinect)
    z = frame.depth_m.astype(np.float64)
    noisy = z + noise_m * np.random.default_rng(0).normal(size=z.shape) * kinect.depth_noise.sigma_m(z)
    measured = with_measured_noise(replace(frame, depth_m=noisy.astype(np.float32)), planes)
    share = measured.camera.depth_noise.c_per_m / kinect.depth_noise.c_per_m
    assert near <= share <= far
    points, _ = readings(measured, np.eye(4), 4, 0.05)
    assert (points[:, 2].max() > 5.9) == (noise_m == 0.0)
    assert with_measured_noise(frame, replace(planes, labels=np.zeros_like(planes.labels))) is frame  # nothing to measure it by


@pytest.mark.parametrize("height_m", [0.25, 0.4])
def test_a_plane_seen_at_a_slant_has_no_stripes(height_m):
    """A floor close below the camera, seen under 7 to 22 degrees: the mesh covers what was seen between 1 and 2 m ahead."""
    floor = ((0.0, -1.0, 0.0, height_m),)
    ahead = [pose_matrix(np.eye(3), np.array([0.0, 0.0, 0.04 * k])) for k in range(6)]
    surface = fold(plugin_class("surface", "tsdf")(view_width=160), [seen(k, T, floor, ball=False) for k, T in enumerate(ahead)])
    corners = surface.vertices_m.astype(float)[surface.triangles]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inside = (np.abs(corners[:, :, 0]) < 0.3).all(axis=1) & (corners[:, :, 2] > 1.0).all(axis=1) & (corners[:, :, 2] < 2.0).all(axis=1)
    assert np.abs(corners[inside][:, :, 1] - height_m).max() < 0.001
    assert -area[inside, 1].sum() == pytest.approx(0.6, rel=0.1)
