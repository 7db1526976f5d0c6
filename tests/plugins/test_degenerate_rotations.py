"""Whatever comes in, every registered estimator of the Manhattan frame and every plugin of the slot `rotation` returns rotations and never raises."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.registry import load_plugins, parameters_of_method, plugins_of
from trihedron.pipeline.core.types import DEGRADED, LOST, OK, Frame, Pose
from trihedron.plugins.tracks.projection import Projection

load_plugins()
ESTIMATORS = {name: plugin() for name, plugin in plugins_of("manhattan").items() if name != "none"}
ROTATIONS = {name: plugin() for name, plugin in plugins_of("rotation").items() if name != "none"}


def named(directions, rng, R):
    """Name -> (normals, segments, planes) that tell too little for a Manhattan frame."""
    nothing, one = directions.normals(rng, clutter=False), directions.normals(rng, R.T[:1], (1.0,), 0.0, clutter=False)
    two_lines, no_lines, no_planes = directions.segments(rng, R.T[:2]), directions.segments(rng), directions.planes(rng)
    broken = replace(nothing, normals=np.full_like(nothing.normals, np.inf))
    nan_lines = replace(two_lines, endpoints_m=np.full_like(two_lines.endpoints_m, np.nan))
    wall = directions.planes(rng, R.T[:1], (0.9,))
    nan_plane = replace(wall, coefficients=np.full_like(wall.coefficients, np.nan), covariance=np.full_like(wall.covariance, np.nan))
    return {
        "no normals": (nothing, no_lines, no_planes),
        "all normals on one axis": (one, no_lines, wall),
        "not a number": (nothing, nan_lines, nan_plane),
        "infinite": (broken, nan_lines, no_planes),
        "two lines": (nothing, two_lines, no_planes),
        "two parallel lines": (nothing, directions.segments(rng, R.T[[0, 0]]), no_planes),
    }


@pytest.mark.parametrize("name", ESTIMATORS)
def test_too_little_is_no_manhattan_frame(directions, name):
    rng = np.random.default_rng(0)
    for _ in range(2):
        R = directions.rotation(rng)
        for what, value in named(directions, rng, R).items():
            for previous in (None, directions.frame(R), directions.frame(directions.rotation(rng), supported=False)):
                found = directions.estimate(ESTIMATORS[name], value, previous)
                directions.check(found)
                assert not found.supported, what


@pytest.mark.parametrize("name", ESTIMATORS)
@settings(max_examples=20, deadline=None, derandomize=True)
@given(data=st.data())
def test_every_estimator_returns_rotations(directions, name, data):
    *value, previous = directions.awkward(data)
    directions.check(directions.estimate(ESTIMATORS[name], value, previous))


class Two:
    """Two frames of a room with their tracks; what they hold is broken afterwards."""

    def __init__(self, room, seed):
        self.rng = np.random.default_rng(seed)
        self.world = room(seed % 7, axes=exp_so3(np.random.default_rng(seed).normal(0, 1, 3)))
        self.camera = pose_matrix(exp_so3(np.radians([1.0, -2.0, 0.5])), np.array([0.03, 0.0, 0.01]))

    def seen(self, T, index, kinds):
        return self.world.see(T, index, self.rng, **kinds)

    def tracks(self, before, now):
        blank = Frame(1, 33_000_000, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), self.world.camera)
        return Projection()(blank.camera, *now, *before, None, None, None, np.random.default_rng(0))

    def broken(self, value, share, what, *names):
        """Rows of the named arrays replaced."""
        rows = {name: getattr(value, name).copy() for name in names}
        for array in rows.values():
            array[self.rng.random(len(array)) < share] = what
        return replace(value, **rows)


def called(plugin, **inputs):
    return plugin(**{name: inputs[name] for name in parameters_of_method("rotation", type(plugin))})


def check(found):
    assert np.allclose(found.R_world_camera @ found.R_world_camera.T, np.eye(3), atol=1e-9) and np.linalg.det(found.R_world_camera) > 0.0
    assert np.isfinite(found.covariance).all() and np.linalg.eigvalsh(found.covariance).min() > -1e-12
    for R in found.R_world_manhattan:
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-9) and np.linalg.det(R) > 0.0
    assert found.source in ("manhattan", "tracks", "prediction") and len(set(found.ids.tolist())) == len(found.ids)


@pytest.mark.parametrize("name", ROTATIONS)
@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_every_rotation_is_one(room, name, data):
    plugin, draw = ROTATIONS[name], lambda label, *values: data.draw(st.sampled_from(values), label=label)
    two = Two(room, data.draw(st.integers(0, 10_000), label="seed"))
    kinds = {kind: draw(kind, True, False) for kind in ("points", "lines", "walls")}
    before, now = two.seen(np.eye(4), 0, kinds), two.seen(two.camera, 1, kinds)
    first = called(
        plugin, camera=two.world.camera, manhattan=two.world.manhattan(np.eye(3), 0, two.rng) if draw("first", True, False) else None,
        tracks=None, keypoints=before[0], segments=before[1], planes=before[2],
        previous=None, previous_pose=None, map=None, rng=np.random.default_rng(0),
    )  # fmt: skip
    check(first)
    share, what = draw("share", 0.0, 0.3, 1.0), draw("with", np.nan, np.inf, 0.0)
    tracks = two.tracks(before, now) if draw("tracked", True, False) else None
    if tracks is not None:
        tracks = two.broken(tracks, share, what, "points_m", "sigma_m", "endpoints_m")
    manhattan = draw("manhattan", None, "good", "turned", "broken")
    if manhattan is not None:
        axes = two.world.axes if manhattan == "good" else exp_so3(two.rng.normal(0, 1, 3))
        manhattan_value = two.world.manhattan(two.camera[:3, :3], 1, two.rng, axes=axes, supported=draw("supported", True, False))
        if manhattan == "broken":
            manhattan_value = replace(manhattan_value, covariance=manhattan_value.covariance * draw("covariance", 0.0, 1e6))
    pose = None
    if draw("pose", True, False):
        spread = np.eye(6) * draw("pose covariance", 0.0, 1e-6, 1.0)
        index, status = draw("pose index", 0, -3), draw("status", OK, DEGRADED, LOST)
        pose = Pose(index, 0, np.eye(4), spread, np.eye(4), -1, np.zeros(3, np.int32), 0, status, "")
    found = called(
        plugin, camera=two.world.camera, manhattan=manhattan_value if manhattan is not None else None, tracks=tracks,
        keypoints=two.broken(now[0], share, what, "points_m", "sigma_m"),
        segments=two.broken(now[1], share, what, "endpoints_m", "covariance_m2"),
        planes=two.broken(now[2], share, draw("planes with", 0.0, 1.0), "covariance"),
        previous=first if draw("previous", True, False) else None, previous_pose=pose, map=None, rng=np.random.default_rng(1),
    )  # fmt: skip
    check(found)
