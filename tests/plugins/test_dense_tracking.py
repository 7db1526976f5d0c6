"""Poses by all pixels, `direct` and `icp`, and the models to track against, `tsdf` and `surfels`: in a painted corner, from known poses."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.lie import exp_se3, rotation_angle_deg
from trihedron.pipeline.core.types import DepthNoise
from trihedron.plugins.model.surfels import SurfelModel
from trihedron.plugins.model.tsdf import TsdfModel
from trihedron.plugins.pose.direct import Direct
from trihedron.plugins.pose.icp import Icp

sys.path.insert(0, str(Path(__file__).parent))
from surface_world import BACK, CAMERA, FLOOR, LEFT, render, seen, walk

CORNER, WALL = (FLOOR, LEFT, BACK), (BACK,)
START = walk(1)[0]
MOVE = np.array([0.02, -0.012, 0.015, 0.008, -0.010, 0.006])  # xi: 2.8 cm and 0.8 degrees
MODELS = {"tsdf": TsdfModel(width=160), "surfels": SurfelModel(width=160, stable=2.0)}
PIXELS = np.stack([*np.mgrid[0 : CAMERA.height, 0 : CAMERA.width][::-1]], axis=-1)


def view(index, T, planes=CORNER, ball=True, paint=True, **given):
    """Frame and pose of a camera at T; the paint is a pattern of space, so that a point is as bright from everywhere."""
    frame, _, _, pose = seen(index, T, planes, ball, **given)
    points = transform(T, CAMERA.back_project(PIXELS.astype(float), frame.depth_m.astype(float)))
    gray = 128.0 + 60.0 * np.sin(9.0 * points).prod(axis=-1) + 60.0 * np.sin(5.0 * points[..., [1, 2, 0]] + 1.0).prod(axis=-1)
    color = np.repeat(np.rint(gray)[..., None], 3, axis=-1).astype(np.uint8) if paint else np.full_like(frame.color, 90)
    return replace(frame, color=color), pose


def off(pose, T):
    """Distance (m) and angle (degrees) of a pose from the truth."""
    D = invert(T) @ pose.T_world_camera
    return np.linalg.norm(D[:3, 3]), rotation_angle_deg(D[:3, :3])


@cache
def modelled(name):
    """The last pose of three from which a model was seen, and its view from there."""
    value, T = None, None
    for index, T in enumerate(walk(3)):
        value = MODELS[name](*view(index, T), value)
    return T, value


def direct(T, before=START, index=1, planes=CORNER, ball=True, paint=True, previous="ok"):
    (then, pose), (now, _) = view(0, before, planes, ball, paint), view(index, T, planes, ball, paint)
    return Direct(width=160)(now, then, replace(pose, status=previous))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_direct_finds_a_known_motion(sign):
    T = START @ exp_se3(sign * MOVE)
    found = direct(T)
    metres, degrees = off(found, T)
    assert metres < 5e-4 and degrees < 0.02 and (found.status, found.unobservable) == ("ok", 0)  # of 2.8 cm and 0.8 degrees


def test_direct_sees_along_a_wall_by_its_paint():
    """A wall across the view: without paint nothing says how the camera slid along it, and only the distance to it is found."""
    T = np.eye(4)
    T[:3, 3] = [0.02, -0.015, 0.02]
    painted, bare = (direct(T, np.eye(4), planes=WALL, ball=False, paint=paint) for paint in (True, False))
    assert painted.status == "ok" and off(painted, T)[0] < 1e-3
    assert (bare.status, bare.unobservable) == ("degraded", 2) and "held at the prediction" in bare.reason
    assert np.abs(bare.T_world_camera[:3, 3] - [0.0, 0.0, 0.02]).max() < 1e-3


@pytest.mark.parametrize("sigma_m", [0.004, 0.012])
def test_direct_does_not_take_noise_for_a_surface_across_a_wall(sigma_m):
    """Noise turns a wall's normals every way: by 3 to 10 degrees here. It measures nothing."""
    rng, depth = np.random.default_rng(0), render(np.eye(4), WALL, ball=False)[0]
    (then, pose), (now, _) = (view(i, np.eye(4), WALL, ball=False, paint=False, depth=depth + rng.normal(0.0, sigma_m, depth.shape)) for i in (0, 1))
    found = Direct(width=160)(now, then, pose)
    assert (found.status, found.unobservable) == ("degraded", 2)


def test_direct_is_lost_where_nothing_can_be_aligned_and_stays_so():
    T = START
    away = T @ exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    for found in (direct(away), direct(T, index=2, planes=(), ball=False)):
        assert found.status == "lost" and "only 0% of the previous frame's pixels agree" in found.reason
        assert np.array_equal(found.T_world_camera, T)
    again = direct(T, previous="lost")
    assert again.status == "lost" and again.reason == "the motion since the pose was lost is not known"


@pytest.mark.parametrize(("name", "photometric"), [("tsdf", 0.0), ("surfels", 0.0), ("surfels", 1.0)])
def test_icp_finds_a_known_motion_against_a_model(name, photometric):
    T, model = modelled(name)
    now = T @ exp_se3(MOVE)
    (frame, _), (_, before) = view(3, now), view(2, T)
    for previous in (before, replace(before, status="lost")):  # a camera that is back where it was lost is found again
        found = Icp(photometric=photometric)(frame, previous, model)
        metres, degrees = off(found, now)
        assert metres < 2e-3 and degrees < 0.1 and (found.status, found.unobservable) == ("ok", 0)


def test_icp_sees_along_a_wall_by_its_paint_alone():
    T = np.eye(4)
    T[:3, 3] = [0.02, -0.015, 0.02]
    model = MODELS["surfels"](*view(0, np.eye(4), WALL, ball=False), None)
    (frame, _), (_, before) = view(1, T, WALL, ball=False), view(0, np.eye(4), WALL, ball=False)
    bare, painted = (Icp(photometric=weight)(frame, before, model) for weight in (0.0, 1.0))
    assert (bare.status, bare.unobservable) == ("degraded", 2) and np.abs(bare.T_world_camera[:3, 3] - [0.0, 0.0, 0.02]).max() < 1e-3
    assert painted.status == "ok" and off(painted, T)[0] < 2e-3


def test_icp_is_lost_where_nothing_can_be_aligned():
    T, model = modelled("tsdf")
    away = T @ exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    for frame in (view(3, T, (), ball=False)[0], view(3, away)[0]):
        found = Icp()(frame, view(2, T)[1], model)
        assert found.status == "lost" and "of the pixels and the model agree" in found.reason
        assert np.array_equal(found.T_world_camera, T)
    unseen = Icp()(view(3, T)[0], view(2, T)[1], None)
    assert (unseen.status, unseen.reason) == ("lost", "there is no view of a model") and np.array_equal(unseen.T_world_camera, T)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_shows_a_wall_from_elsewhere_and_nothing_where_none_was_seen(name):
    """Its right half is seen twice, then nothing from a pose that is moved and turned: the wall is shown where it stands, and nothing beside it."""
    half = np.where(np.arange(CAMERA.width) >= CAMERA.width // 2, render(np.eye(4), WALL, ball=False)[0], 0.0)
    model = None
    for index in range(2):
        model = MODELS[name](*view(index, np.eye(4), WALL, ball=False, depth=half), model)
    T = exp_se3(np.array([0.1, -0.05, 0.3, 0.02, -0.1, 0.03]))
    truth = render(T, WALL, ball=False)[0]
    shown = MODELS[name](*view(2, T, WALL, ball=False, depth=np.zeros_like(truth)), model)
    side = transform(T, CAMERA.back_project(PIXELS.astype(float), truth))[..., 0] * CAMERA.fx / 3.0  # px of the first view, from its middle
    wall, empty = (side > 4.0) & (side < 70.0), side < -4.0
    known = shown.depth_m > 0.0
    assert wall.sum() > 5000 < empty.sum() and known[wall].mean() > 0.9 and not known[empty].any()
    assert np.abs(shown.depth_m - truth)[known & wall].max() < 3e-3
    normals = shown.normals[known & wall]
    normals = normals[np.isfinite(normals).all(axis=1)]
    assert len(normals) > 3000 and (normals @ (T[:3, :3].T @ BACK[:3])).min() > 0.99
    assert np.array_equal(shown.T_world_camera, T) and (shown.depth_m.shape == shown.color.shape[:2] == truth.shape)


@pytest.mark.parametrize("name", MODELS)
def test_what_is_seen_twice_is_averaged_and_a_lost_camera_says_nothing(name):
    """A wall read at 3.00 m and then at 3.02 m, well within the noise of a sensor, stands at 3.01 m."""
    camera, model, rows = replace(CAMERA, depth_noise=DepthNoise()), None, []
    for index, z in enumerate((3.0, 3.02)):
        model = MODELS[name](*view(index, np.eye(4), ((0.0, 0.0, -1.0, z),), ball=False, camera=camera), model)
        rows.append(len(model.model))
    assert rows[1] < 1.1 * rows[0]  # it is one wall
    assert abs(np.median(model.depth_m[model.depth_m > 0.0]) - 3.01) < 1e-3 and (model.depth_m > 0.0).mean() > 0.9
    assert MODELS[name](*view(2, np.eye(4), WALL, ball=False, status="lost"), model) is None


def test_the_first_frame_is_the_origin():
    frame, _ = view(0, START)
    for found in (Direct()(frame, None, None), Icp()(frame, None, None)):
        assert found.status == "ok" and np.array_equal(found.T_world_camera, np.eye(4))
