"""Steps of the map's stage through a room that is known."""

import numpy as np
from landmark_world import camera_at, rotation_of, translation_of

from trihedron.pipeline.core.arrays import array_specs
from trihedron.pipeline.core.types import Correction, Pose
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.matches.local_map import LocalMap

EVERY = Covisibility(min_frames=1, max_frames=1, min_shift=1e-3)  # each frame of a moving camera is a keyframe
TABLES = ("keyframes", "points", "lines", "planes", "point_observations", "line_observations", "plane_observations")
KNOWN = (("point_information", "point_ids", (), 1e5), ("line_information", "line_ids", (2,), 1e4), ("plane_covariance", "plane_ids", (), 1e-5))


def pose_of(T, index, status="ok", inliers=(0, 0, 0), **more):
    return Pose(index, index * 33_000_000, T, np.eye(6) * 1e-10, T, -1, np.array(inliers, np.int32), 0, status, "", **more)


def step(stage, world, map, index, at=None, features=None, bundle=None, loop=None, recognised=None, frame=None, **pose):
    """The map after frame `index`, whose camera stands at step `at` of the path and is known exactly; None when the stage says None."""
    T = camera_at(index if at is None else at)
    features, frame = features or world.features(T, index), frame or world.frame(index)
    matches = LocalMap()(frame.camera, rotation_of(T, index), translation_of(T, index), *features, map, None)
    return stage(frame, pose_of(T, index, **pose), *features, matches, map, bundle, loop, recognised)


def walk(world, count, stage=EVERY, stride=1):
    map = None
    for index in range(count):
        map = step(stage, world, map, index, at=index * stride) or map
    return map


def rows_of_world(world, map):
    """The world's row of each map point: the nearest one with the same descriptor."""
    same = (map.points.column("descriptor")[:, None] == world.descriptor[None]).all(axis=2)
    assert (same.sum(axis=1) == 1).all()
    return same.argmax(axis=1)


def correction(map, **changes):
    none = {
        "based_on": map.revision, "keyframe_ids": np.empty(0, np.int32), "T_world_keyframe": np.empty((0, 4, 4)), "point_ids": np.empty(0, np.int32),
        "points_m": np.empty((0, 3)), "line_ids": np.empty(0, np.int32), "endpoints_m": np.empty((0, 2, 3)), "plane_ids": np.empty(0, np.int32),
        "coefficients": np.empty((0, 4)),
    }  # fmt: skip
    given = {**none, **changes}
    of = {spec.name: spec.dtype for spec in array_specs(Correction)}
    known = {name: np.tile(np.eye(3) * scale, (len(given[ids]), *shape, 1, 1)).astype(of[name]) for name, ids, shape, scale in KNOWN}
    return Correction(map.index, map.stamp_ns, **known, **given)
