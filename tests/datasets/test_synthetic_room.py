"""The synthetic room: exact geometry and truth, determinism, and scenes worth tracking."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from trihedron.datasets.simulation.motion import Motion, camera_pose
from trihedron.datasets.simulation.raytracing import geometry_of
from trihedron.datasets.simulation.room import CYLINDER, SPHERE, Face, Room, Solid, all_faces, furnished_room
from trihedron.datasets.simulation.shading import render
from trihedron.datasets.simulation.synthetic import Scene, Synthetic
from trihedron.datasets.simulation.textures import bake
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import transform
from trihedron.pipeline.core.lie import rotation_angle_deg
from trihedron.pipeline.core.types import EXACT_DEPTH, Camera, DepthNoise

SMALL = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


def seen_points(room: Room, pose: np.ndarray, camera: Camera = SMALL) -> tuple[np.ndarray, np.ndarray]:
    """World points (float32 depth) and face numbers of every pixel."""
    _, depth, faces, _ = render(geometry_of(room), bake(all_faces(room), False, 0), camera, pose)
    y, x = np.mgrid[: camera.height, : camera.width]
    points = camera.back_project(np.stack([x, y], axis=-1).astype(float), depth.astype(np.float32).astype(float))
    return transform(pose, points).reshape(-1, 3), faces.ravel()


def surface_distance(points: np.ndarray, face: Face, radius: float) -> np.ndarray:
    if face.curved == CYLINDER:
        return np.hypot(*(points - face.origin)[:, :2].T) - radius
    if face.curved == SPHERE:
        return np.linalg.norm(points - face.origin, axis=1) - radius
    return (points - face.origin) @ face.normal


@pytest.mark.parametrize("slanted", [False, True])
def test_back_projected_depth_lies_on_the_surfaces(slanted: bool) -> None:
    room = furnished_room(slanted)
    radii = [0.0] * len(room.faces) + [float(solid.half[0]) for solid in room.solids for _ in solid.faces]
    kinds: set[int] = set()
    for time_s in (0.0, 12.0, 21.0, 33.0, 47.0):
        points, faces = seen_points(room, camera_pose(Motion.walk, 0, time_s))
        for number in np.unique(faces):
            face = all_faces(room)[number]
            kinds.add(face.curved)
            on_face = points[faces == number]
            assert np.abs(surface_distance(on_face, face, radii[number])).max() < 2e-6
            if not face.curved:
                inside = np.stack([(on_face - face.origin) @ face.u, (on_face - face.origin) @ face.v], axis=-1)
                assert (inside > -1e-5).all() and (number in range(4, 6) or (inside < np.array(face.size_m) + 1e-5).all())
    assert kinds == {0, CYLINDER, SPHERE}


def first_hit(room: Room, origin: np.ndarray, ray: np.ndarray) -> float:
    """The nearest intersection by marching through every surface of the room, without any shortcut."""
    hits = [-(n[:3] @ origin + n[3]) / (n[:3] @ ray) for n in room.planes if n[:3] @ ray < 0]
    for solid in room.solids:
        hits += hits_of(solid, solid.R_world_solid.T @ (origin - solid.centre), solid.R_world_solid.T @ ray)
    return min(t for t in hits if t > 0)


def hits_of(solid: Solid, o: np.ndarray, d: np.ndarray) -> list[float]:
    if solid.kind == SPHERE:
        roots = np.roots([d @ d, 2 * o @ d, o @ o - solid.half[0] ** 2])
        return [float(t.real) for t in roots if abs(t.imag) < 1e-12]
    found = []
    for axis in range(3):
        for side in (-solid.half[axis], solid.half[axis]):
            t = (side - o[axis]) / d[axis]
            p = o + t * d
            outside = np.abs(p) > solid.half + 1e-12
            outside[axis] = False
            flat = solid.kind != CYLINDER or (axis == 2 and np.hypot(p[0], p[1]) <= solid.half[0])
            if flat and (solid.kind == CYLINDER or not outside.any()):
                found.append(float(t))
    if solid.kind == CYLINDER:
        roots = np.roots([d[0] ** 2 + d[1] ** 2, 2 * (o[0] * d[0] + o[1] * d[1]), o[0] ** 2 + o[1] ** 2 - solid.half[0] ** 2])
        found += [float(t.real) for t in roots if abs(t.imag) < 1e-12 and abs(o[2] + t.real * d[2]) <= solid.half[2]]
    return found


@pytest.mark.parametrize("time_s", [0.0, 9.0, 26.0, 41.0])
def test_nothing_is_seen_through(time_s: float) -> None:
    """Depth is that of the nearest of all surfaces, for random pixels."""
    room, pose = furnished_room(), camera_pose(Motion.walk, 3, time_s)
    _, depth, _, _ = render(geometry_of(room), bake(all_faces(room), False, 0), SMALL, pose)
    rng = np.random.default_rng(0)
    for x, y in zip(rng.integers(0, 320, 200), rng.integers(0, 240, 200)):
        ray = pose[:3, :3] @ np.array([(x - SMALL.cx) / SMALL.fx, (y - SMALL.cy) / SMALL.fy, 1.0])
        assert depth[y, x] == pytest.approx(first_hit(room, pose[:3, 3], ray), abs=1e-9)


def test_a_solid_reaching_behind_the_camera_is_seen() -> None:
    """Low over the table: parts of it are beside and behind the camera."""
    room, pose = furnished_room(), camera_pose(Motion.walk, 0, 0.0).copy()
    pose[:3, 3] = (2.0, 0.4, 0.79)
    _, depth, _, _ = render(geometry_of(room), bake(all_faces(room), False, 0), SMALL, pose)
    for x, y in ((5, 239), (160, 235), (310, 230), (160, 20)):
        ray = pose[:3, :3] @ np.array([(x - SMALL.cx) / SMALL.fx, (y - SMALL.cy) / SMALL.fy, 1.0])
        assert depth[y, x] == pytest.approx(first_hit(room, pose[:3, 3], ray), abs=1e-9)
    assert depth[235, 160] < 0.2


def test_depth_agrees_under_the_truth(warp_error_m: Callable[..., float]) -> None:
    for noise, limit in ((False, 0.003), (True, 0.03)):
        dataset = Synthetic(noise=noise, texture=False)
        truth, a, b = dataset.truth(), dataset(10), dataset(40)
        assert truth is not None and a is not None and b is not None
        assert (truth.stamps_ns[40], truth.stamps_ns[10]) == (b.stamp_ns, a.stamp_ns)
        assert warp_error_m(a, b, truth.poses[10], truth.poses[40]) < limit
        assert warp_error_m(a, b, truth.poses[10], truth.poses[10]) > 0.08


def test_a_frame_depends_on_its_number_alone() -> None:
    one, other = Synthetic(width=160, height=120, seed=5), Synthetic(width=160, height=120, seed=5, frames="20:60")
    forward = {20 + i: other(i) for i in range(4)}
    with ThreadPoolExecutor(4) as pool:
        threaded = dict(zip((23, 20, 22, 21), pool.map(one, (23, 20, 22, 21))))
    for number, frame in forward.items():
        again = threaded[number]
        assert frame is not None and again is not None and frame.index == again.index == number
        assert frame.stamp_ns == again.stamp_ns == round(number * 1e9 / 30)
        assert frame.color.tobytes() == again.color.tobytes() and frame.depth_m.tobytes() == again.depth_m.tobytes()
    different = Synthetic(width=160, height=120, seed=6)(20)
    assert different is not None and different.color.tobytes() != forward[20].color.tobytes()


def test_the_selection_and_its_truth() -> None:
    dataset = Synthetic(length=40, frames="30:", fps=20.0)
    assert len(dataset) == 10
    truth = dataset.truth()
    assert truth is not None and len(truth) == 40 and truth.stamps_ns[30] == 1_500_000_000
    with pytest.raises(DataError) as caught:
        len(Synthetic(length=40, frames="40:"))
    expected = "dataset.frames: '40:' begins beyond the 40 frames of the synthetic room (dataset.length); give a range within 0:40"
    assert str(caught.value) == expected


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"length": -1}, "length: -1 is not at least 0"),
        ({"fps": -1.0}, "fps: -1.0 is not positive"),
        ({"width": 8}, "width: 8 is not within 16 … 8192"),
        ({"seed": -1}, "seed: -1 is not at least 0"),
        ({"scene": Scene.rooms, "motion": Motion.pan}, "motion: pan is for the room, a building is walked through"),
        ({"scene": Scene.offices, "slanted": True}, "slanted: only the room has slanted walls"),
        ({"frames": "5"}, "frames: '5' is not a range of frames A:B[:S] with A < B, S > 0"),
    ],
)
def test_values_out_of_range_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        Synthetic(**values)
    assert str(caught.value) == message


def test_the_walk_is_a_hand_held_one() -> None:
    """Under 0.5 m/s and 40 °/s, and 0.4 m or more from everything, for a minute of several seeds."""
    for seed in range(4):
        poses = np.array([camera_pose(Motion.walk, seed, i / 30) for i in range(1800)])
        speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 30
        turning = [rotation_angle_deg(a[:3, :3].T @ b[:3, :3]) * 30 for a, b in pairwise(poses)]
        assert 0.3 < speed.max() < 0.5 and 20.0 < max(turning) < 40.0
        for slanted in (False, True):
            room = furnished_room(slanted)
            x = poses[:, :3, 3]
            clearance = [(x @ room.planes[:, :3].T + room.planes[:, 3]).min()]
            for solid in room.solids:
                beyond = np.maximum(np.abs((x - solid.centre) @ solid.R_world_solid) - solid.half, 0.0)
                clearance.append(np.linalg.norm(beyond, axis=1).min())
            assert min(clearance) > 0.4


def test_the_fast_walk_is_fast_and_stays_clear() -> None:
    """0.8 to 1.3 m/s and 60 to 100 °/s at its fastest, along the places of the slow walk."""
    for seed in range(2):
        poses = np.array([camera_pose(Motion.fast, seed, i / 30) for i in range(600)])
        speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 30
        turning = [rotation_angle_deg(a[:3, :3].T @ b[:3, :3]) * 30 for a, b in pairwise(poses)]
        assert 0.8 < speed.max() < 1.3 and 60.0 < max(turning) < 100.0
        np.testing.assert_array_equal(poses[30], camera_pose(Motion.walk, seed, 2.5))


def test_still_and_pan() -> None:
    still = Synthetic(motion=Motion.still, length=30).truth()
    pan = Synthetic(motion=Motion.pan, length=31).truth()
    assert still is not None and pan is not None
    assert (still.poses == still.poses[0]).all()
    assert (pan.poses[:, :3, 3] == pan.poses[0, :3, 3]).all()
    assert rotation_angle_deg(pan.poses[0, :3, :3].T @ pan.poses[30, :3, :3]) == pytest.approx(20.0, abs=0.2)


def test_two_directions_of_walls_are_in_view() -> None:
    """Flat faces of two directions or more, each on 5 % of the image, in 9 of 10 frames; three in the first."""
    room = furnished_room()
    faces = all_faces(room)
    directions = []
    for time_s in np.arange(0.0, 60.0, 2.0):
        _, numbers = seen_points(room, camera_pose(Motion.walk, 0, float(time_s)), Camera(160, 120, 131.0, 131.0, 79.5, 59.5))
        share: dict[tuple[float, ...], int] = {}
        for number, count in zip(*np.unique(numbers, return_counts=True)):
            if not faces[number].curved:
                normal = tuple(np.abs(faces[number].normal).round(2))
                share[normal] = share.get(normal, 0) + int(count)
        directions.append(sum(count >= 0.05 * len(numbers) for count in share.values()))
    assert directions[0] >= 3
    assert np.mean(np.array(directions) >= 2) >= 0.9


def test_slanted_walls_leave_the_manhattan_frame() -> None:
    def angles(room: Room) -> np.ndarray:
        n = room.planes[:4, :3]
        return np.degrees(np.arccos(np.clip((n * np.roll(n, -1, axis=0)).sum(axis=1), -1, 1)))

    np.testing.assert_allclose(angles(furnished_room()), 90.0, atol=1e-9)
    assert np.abs(angles(furnished_room(slanted=True)) - 90.0).max() > 8.0


def long_lines(gray: np.ndarray) -> int:
    lines = cv2.createLineSegmentDetector().detect(gray)[0].reshape(-1, 4)
    return int((np.hypot(*(lines[:, :2] - lines[:, 2:]).T) > 40.0).sum())


def test_texture_gives_corners_and_a_bare_room_gives_lines() -> None:
    orb = cv2.ORB_create(1000)
    counts = {}
    for texture in (True, False):
        dataset = Synthetic(length=1800, texture=texture)
        frames = [dataset(i).gray for i in range(0, 1800, 300)]
        counts[texture] = ([len(orb.detect(gray, None)) for gray in frames], [long_lines(gray) for gray in frames])
    assert min(counts[True][0]) > 700
    assert np.median(counts[False][0]) < 80
    assert min(counts[True][1]) > 30 and min(counts[False][1]) >= 10


def test_exact_depth_says_so() -> None:
    exact, noisy = Synthetic(width=64, height=48, noise=False)(0), Synthetic(width=64, height=48)(0)
    assert exact is not None and noisy is not None
    assert exact.camera.depth_noise == EXACT_DEPTH and noisy.camera.depth_noise == DepthNoise()
    assert (exact.depth_m > 0).all()
    assert exact.camera.fx == pytest.approx(52.5)


def test_its_camera_is_exact_and_says_so():
    assert set(asdict(Synthetic(width=64, height=48)(0).camera.sigmas).values()) == {0.0}
