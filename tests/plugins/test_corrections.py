"""What a correction does to the map: it moves what it names, and what came after."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, transform, transform_planes
from trihedron.pipeline.core.lie import adjoint, exp_se3
from trihedron.pipeline.core.table import CHUNK
from trihedron.pipeline.core.types import CALIBRATION
from trihedron.plugins.mapping import plane_fusion
from trihedron.plugins.mapping.correction import apply_correction
from trihedron.plugins.mapping.covisibility_graph import local_window, observed_by
from trihedron.plugins.mapping.insertion import add_keyframe
from trihedron.plugins.mapping.landmark_kinds import LINE, POINT
from trihedron.plugins.mapping.landmarks import ALIGNMENT, KEYFRAMES

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import World, camera_at
from map_steps import EVERY, correction, pose_of, step, walk


@pytest.mark.parametrize("wire", ["bundle", "loop"])
def test_a_correction_moves_what_it_names_and_nothing_else(wire):
    world = World()
    map = walk(world, 4)
    dead = map.points.updated(np.array([3]), alive=np.array([False]))
    map = dataclasses.replace(map, points=dead)
    old = {name: map.points.column("position_m") for name in ("points",)}["points"]
    plane = map.planes.column("coefficients")[1].copy()
    plane[3] += 0.05
    ends = map.lines.column("endpoints_m")[2] + 0.01
    moved = correction(
        map, point_ids=np.array([1, 3, 99_999], np.int32), points_m=old[[1, 3, 0]] + 0.1, line_ids=np.array([2], np.int32), endpoints_m=ends[None],
        plane_ids=np.array([1], np.int32), coefficients=plane[None], keyframe_ids=np.array([2, 3], np.int32),
        T_world_keyframe=np.stack([camera_at(2) @ exp_se3(np.full(6, 0.01)), camera_at(3)]),
    )  # fmt: skip
    after = step(EVERY, world, map, 4, at=3.0001, status="lost", **{wire: moved})
    assert after.revision == map.revision + 1 and len(after.keyframes) == 4
    expected = old.copy()
    expected[1] += 0.1
    assert np.allclose(after.points.column("position_m"), expected)
    assert np.allclose(after.lines.column("endpoints_m")[2], ends)
    assert np.allclose(after.planes.column("coefficients")[1], plane)
    fitted, _ = plane_fusion.fit_planes(after.planes.column("moments"), after.planes.column("coefficients"))
    assert np.allclose(fitted, after.planes.column("coefficients"), atol=1e-6)  # the moments moved along, so the next frame does not undo it
    assert np.allclose(after.points.column("information")[1], np.eye(3) * 1e5) and np.allclose(after.lines.column("information")[2], np.eye(3) * 1e4)
    assert np.allclose(after.planes.column("covariance")[1], np.eye(3) * 1e-5)
    again = plane_fusion.fit_planes(after.planes.rows("moments", np.array([1])), plane[None])[1]
    assert np.allclose(again, np.eye(3) * 1e-5, rtol=1e-6)  # one measurement's worth: what is fused later is weighed against just that
    assert np.allclose(after.keyframes.column("T_world_camera")[2], camera_at(2) @ exp_se3(np.full(6, 0.01)))


def test_what_came_after_the_corrected_keyframes_moves_with_them():
    """A correction of keyframes 0 to 2 arrives when keyframe 3 and its landmarks exist: the whole is moved rigidly and so is the rest."""
    world = World()
    map = walk(world, 4, stride=6)
    shift = exp_se3(np.array([0.1, -0.05, 0.02, 0.01, 0.03, -0.02]))
    poses = shift @ map.keyframes.column("T_world_camera")
    early = {kind: np.flatnonzero(getattr(map, kind).column("first") < 3).astype(np.int32) for kind in ("points", "lines", "planes")}
    assert any(len(early[kind]) < len(getattr(map, kind)) for kind in early)
    moved = correction(
        map,
        keyframe_ids=np.arange(3, dtype=np.int32),
        T_world_keyframe=poses[:3],
        point_ids=early["points"],
        points_m=transform(shift, map.points.rows("position_m", early["points"])),
        line_ids=early["lines"],
        endpoints_m=transform(shift, map.lines.rows("endpoints_m", early["lines"])),
        plane_ids=early["planes"],
        coefficients=transform_planes(shift, map.planes.rows("coefficients", early["planes"])),
    )
    after = step(EVERY, world, map, 4, status="lost", loop=moved)
    assert np.allclose(after.keyframes.column("T_world_camera"), poses)
    alive = after.points.column("alive")
    assert np.allclose(after.points.column("position_m")[alive], transform(shift, map.points.column("position_m"))[alive])
    alive = after.lines.column("alive")
    assert np.allclose(after.lines.column("endpoints_m")[alive], transform(shift, map.lines.column("endpoints_m"))[alive])
    assert np.allclose(after.planes.column("coefficients"), transform_planes(shift, map.planes.column("coefficients")))


def test_errors_by_the_calibration_are_corrected_with_the_keyframes():
    """A correction of keyframes 0 to 2 takes half of their errors, and arrives when keyframe 3 exists: that errs as keyframe 2, carried there, and by
    what it differed from that before. So do the columns of alignments. A correction that names no errors leaves them."""
    map = walk(World(), 4, stride=6)
    rng = np.random.default_rng(0)
    before = {name: rng.normal(size=(4, *KEYFRAMES[name].shape)) for name in ("sensitivity", *ALIGNMENT)}
    map = dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(4), **before))
    poses = map.keyframes.column("T_world_camera")
    moved = correction(map, keyframe_ids=np.array([2, 0, 1], np.int32), T_world_keyframe=poses[[2, 0, 1]])
    half = dataclasses.replace(moved, **{name: 0.5 * value[[2, 0, 1]] for name, value in before.items()})
    to_last = adjoint(invert(poses[3]) @ poses[2])
    after = apply_correction(map, half).keyframes
    for name, value in before.items():
        assert after.column(name)[:3] == pytest.approx(0.5 * value[:3])
        assert after.column(name)[3] == pytest.approx(value[3] - 0.5 * to_last @ value[2])
    known = dataclasses.replace(half, calibration_errors=np.ones(CALIBRATION))
    assert np.array_equal(apply_correction(map, known).calibration_errors, np.ones(CALIBRATION)) and not map.calibration_errors.any()
    stranger = dataclasses.replace(moved, sensitivity=before["sensitivity"])  # of four keyframes, for three
    for unchanged in (moved, stranger):
        assert all(np.array_equal(apply_correction(map, unchanged).keyframes.column(name), value) for name, value in before.items())


def test_a_new_keyframe_was_aligned_as_its_reference_keyframe():
    """It moves with that, so that its errors would, too, if nothing had been undone; the first keyframe has no reference."""
    world = World()
    map = walk(world, 2, stride=6)
    assert not any(map.keyframes.column(name).any() for name in ALIGNMENT)
    rng = np.random.default_rng(0)
    before = {name: rng.normal(size=(2, *KEYFRAMES[name].shape)) for name in ALIGNMENT}
    map = dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(2), **before))
    T = camera_at(12.0)
    to_newest = adjoint(invert(T) @ map.keyframes.row("T_world_camera", 1))
    pose = dataclasses.replace(pose_of(T, 2), reference=1, T_reference_camera=invert(map.keyframes.row("T_world_camera", 1)) @ T)
    evidence = {"calibration_information": np.diag(np.arange(CALIBRATION, dtype=np.float64)), "calibration_score": np.ones(CALIBRATION)}
    grown = add_keyframe(map, dataclasses.replace(pose, **evidence), world.frame(2).camera)[0]
    assert all(np.array_equal(getattr(grown, name), value) for name, value in evidence.items())
    after = grown.keyframes
    assert all(after.column(name)[2] == pytest.approx(to_newest @ before[name][1]) for name in ALIGNMENT)


def test_keyframes_that_others_make_redundant_are_retired():
    """A camera that goes to and fro over 0.3 m for 60 keyframes: what three others see as well is no longer part of any window."""
    world, stage, map = World(), dataclasses.replace(EVERY, redundant=3), None
    counts = []
    for index in range(60):
        at = 12.0 * np.sin(0.4 * index)
        map = step(stage, world, map, index, at=at) or map
        assert not len(map.keyframes) or map.keyframes.column("alive")[[0, -1]].all()
        counts.append(int(map.keyframes.column("alive").sum()))
    alive = map.keyframes.column("alive")
    assert len(alive) == 60 and max(counts) < 20 and max(counts[40:]) <= max(counts[:40]) + 1  # bounded, however long it stays
    poses = np.stack([camera_at(12.0 * np.sin(0.4 * index)) for index in range(60)])
    assert np.array_equal(map.keyframes.column("T_world_camera"), poses)
    window = local_window(map, poses[-1], 2, 10, 3)
    assert alive[window.keyframes].all() and len(window.points) > 50


def test_a_way_gone_again_and_again_leaves_the_map_as_it_was_after_the_first_time():
    """To and fro eight times, a keyframe a step: no more of them than after the first time, nor of landmarks; memory is given back."""
    world, map, held = World(), None, []
    for index in range(120):
        there = 4 * (index % 30)
        map = step(dataclasses.replace(EVERY, min_shift=0.06), world, map, index, at=min(there, 120 - there)) or map
        if index % 30 == 29:
            landmarks = sum(np.count_nonzero(table.column("alive")) for table in (map.points, map.lines, map.planes))
            seen = map.point_observations
            held.append((int(map.keyframes.column("alive").sum()), landmarks, sum(not seen.is_empty(k) for k in range(-(-len(seen) // CHUNK)))))
    keyframes, landmarks, chunks = (np.array(column) for column in zip(*held))
    assert len(map.keyframes) == 120 and len(map.point_observations) > 6000  # rows keep their numbers
    assert keyframes.max() <= keyframes[0] + 2 < 20 and landmarks.max() < 1.1 * landmarks[0] and chunks.max() < 9
    alive = np.flatnonzero(map.keyframes.column("alive")).astype(np.int32)
    assert {0, 1, 2} <= set(alive) and (alive[-4:] == np.arange(116, 120)).all()
    for kind, table in ((POINT, map.points), (LINE, map.lines)):  # what lives is seen by what lives
        assert np.array_equal(observed_by(map, alive, kind), np.flatnonzero(table.column("alive")))
        assert np.isin(table.column("observers")[table.column("alive")], [*alive, -1]).all()


def test_a_keyframe_is_not_redundant_when_the_others_are_far_behind_or_see_something_else():
    """Walking on, every keyframe sees something that too few others do."""
    map = walk(World(2000), 14, dataclasses.replace(EVERY, redundant=8), stride=8)
    assert map.keyframes.column("alive").all()


def test_an_adjustment_that_began_before_a_loop_was_closed_does_not_undo_it():
    """A loop moves the newest keyframe by 0.2 m; the bundle adjustment of the version before says otherwise, that of the version after counts."""
    world = World()
    map = walk(world, 4)
    late, pose = correction(map, keyframe_ids=np.array([3], np.int32), T_world_keyframe=camera_at(3)[None]), camera_at(3).copy()
    pose[0, 3] += 0.2
    closed = step(EVERY, world, map, 4, status="lost", loop=correction(map, keyframe_ids=np.array([3], np.int32), T_world_keyframe=pose[None]))
    assert closed.loop_closed == closed.revision and np.array_equal(closed.keyframes.row("T_world_camera", 3), pose)
    assert step(EVERY, world, closed, 5, status="lost", bundle=late) is None
    next_one = dataclasses.replace(late, based_on=closed.revision)
    adjusted = step(EVERY, world, closed, 5, status="lost", bundle=next_one)
    assert np.array_equal(adjusted.keyframes.row("T_world_camera", 3), camera_at(3)) and adjusted.loop_closed == closed.revision


def test_rounding_does_not_grow_from_keyframe_to_keyframe():
    """Each correction puts keyframe 2 where keyframe 3 is, which moves on with it: without care, twice the error is handed on each time."""
    map = walk(World(), 4)
    for _ in range(60):
        target = map.keyframes.row("T_world_camera", 3)
        map = apply_correction(map, correction(map, keyframe_ids=np.array([2], np.int32), T_world_keyframe=target[None]))
    R = map.keyframes.column("T_world_camera")[:, :3, :3]
    assert np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < 1e-9
