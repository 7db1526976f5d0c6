"""Tables of the landmark map: keyframes, landmarks and their observations; and sets of their ids."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import CALIBRATION, I32, Bool, Column, Map, Table

POSITION = Column("f8", (3,), 2.0**-20)  # in the world, to a micrometre: a thousandth of any standard deviation
ENDPOINTS = Column("f8", (2, 3), POSITION.step)
COARSE = 2.0**-10  # 1 mm, or 0.06°: for values only compared with thresholds of centimetres and degrees
OBSERVERS = 16  # most recent keyframes remembered by a landmark, enough for co-visibility; -1 = empty

KEYFRAMES = {
    "index": Column("i4"),  # frame number
    "stamp_ns": Column("i8"),
    "T_world_camera": Column("f8", (4, 4)),
    "covariance": Column("f8", (6, 6)),  # of its pose relative to the landmarks near it, see types
    "world_covariance": Column("f8", (6, 6)),  # of its pose in the world, by drift
    "sensitivity": Column("f8", (6, CALIBRATION)),  # of its pose's error to the calibration, see `shared.calibration_error`
    "aligned": Column("f8", (6,)),  # xi by which alignments with the Manhattan frame have moved it: without them, `T_world_camera · Exp(-xi)`
    "undone": Column("f8", (6,)),  # the part of this that undid errors by the calibration
    "undone_sensitivity": Column("f8", (6, CALIBRATION)),  # what they have taken off its sensitivity
    "twist": Column("f8", (6,)),  # velocity of the camera (m/s, rad/s), in its frame
    "intrinsics": Column("f8", (4,)),  # fx, fy, cx, cy
    "points": Column("i4", (2,)),  # its rows of the observation tables, half open
    "lines": Column("i4", (2,)),
    "planes": Column("i4", (2,)),
    "submap": Column("i4"),  # poses of different sub-maps are in different worlds
    "alive": Column("?"),
}
ALIGNMENT = "aligned", "undone", "undone_sensitivity"  # what a new keyframe has from its reference keyframe


def point_columns(descriptor_bytes: int) -> dict[str, Column]:
    """Columns of points: `information` is the inverse covariance of the position (world, 1/m²); `distance_m` and `octave` are the range and scale of
    the last observation."""
    return {
        "position_m": POSITION,
        "information": Column("f4", (3, 3)),
        "descriptor": Column("u1", (descriptor_bytes,)),
        "direction": Column("f4", (3,), COARSE),  # unit, from the point to the camera that saw it last
        "distance_m": Column("f4", step=COARSE),
        "octave": Column("u1"),
        **_life(),
    }


def line_columns(descriptor_bytes: int) -> dict[str, Column]:
    """Columns of lines: end points in the world with the inverse covariance of each."""
    descriptor = Column("u1", (descriptor_bytes,))
    return {"endpoints_m": ENDPOINTS, "information": Column("f4", (2, 3, 3)), "descriptor": descriptor, **_life()}


def plane_columns(samples: int) -> dict[str, Column]:
    """Columns of world planes, re-estimated from `moments`, the sum over their observations (`plane_fusion.equivalent_moments`); n points to the
    side the plane was observed from, d has any sign."""
    return {
        "coefficients": Column("f8", (4,)),
        "covariance": Column("f8", (3, 3)),  # of (a, b, d), see types.Planes
        "moments": Column("f8", (4, 4)),
        "samples_m": Column("f4", (samples, 3), COARSE),
        **_life(),
    }


def _life() -> dict[str, Column]:
    return {
        "first": Column("i4"),  # keyframe that created it
        "observers": Column("i4", (OBSERVERS,)),
        "found": Column("i4"),  # keyframes in which it was matched
        "visible": Column("i4"),  # keyframes in which it should have been
        "alive": Column("?"),
    }


POINT_OBSERVATIONS = {
    "keyframe": Column("i4"),
    "point": Column("i4"),
    "pixel": Column("f4", (2,)),
    "depth_m": Column("f4"),  # NaN = none
    "sigma_px": Column("f4"),
    "sigma_m": Column("f4"),
}
LINE_OBSERVATIONS = {  # as `types.Segments`, camera frame; NaN without a 3D line
    "keyframe": Column("i4"),
    "line": Column("i4"),
    "endpoints_px": Column("f4", (2, 2)),
    "endpoints_m": Column("f4", (2, 3)),
    "covariance_m2": Column("f4", (2, 3, 3)),
}
PLANE_OBSERVATIONS = {  # as `types.Planes`, camera frame
    "keyframe": Column("i4"),
    "plane": Column("i4"),
    "coefficients": Column("f8", (4,)),
    "covariance": Column("f8", (3, 3)),
    "moments": Column("f8", (4, 4)),
}


def empty_map(index: int, stamp_ns: int, point_bytes: int, line_bytes: int, plane_samples: int) -> Map:
    """A map without keyframes, for descriptors of the given lengths."""
    landmarks = point_columns(point_bytes), line_columns(line_bytes), plane_columns(plane_samples)
    schemas = (KEYFRAMES, *landmarks, POINT_OBSERVATIONS, LINE_OBSERVATIONS, PLANE_OBSERVATIONS)
    keyframes, points, lines, planes, *observations = (Table.empty(schema) for schema in schemas)
    return Map(index, stamp_ns, 0, keyframes, points, lines, planes, observations[0], observations[1], observations[2])


def remove_rows(table: Table, ids: I32) -> Table:
    """Mark landmarks or keyframes as dead; their rows remain."""
    return table.updated(ids, alive=np.zeros(len(ids), np.bool_))


def newest_first(observers: I32) -> I32:
    """Return the observers (n, k) of landmarks in their order, the newest keyframe first, empty places (-1) last."""
    return np.asarray(-np.sort(-observers, axis=1))


# Sets of ids, as sorted rows. Ids lie close together, so marking them beats sorting them.


def distinct(ids: I32) -> I32:
    """Return the different ids (n,), sorted."""
    if len(ids) == 0:
        return ids
    first = ids.min()
    marked = np.zeros(ids.max() - first + 1, np.bool_)
    marked[ids - first] = True
    return np.asarray((np.flatnonzero(marked) + first).astype(np.int32))


def union(a: I32, b: I32) -> I32:
    """Return the ids of both (n,), once each and sorted."""
    marked = _membership_mask(b, _end(a, b))
    marked[a] = True
    return np.flatnonzero(marked).astype(np.int32)


def isin(ids: I32, others: I32) -> Bool:
    """Return True (n,) for the ids that are among the others."""
    found: Bool = _membership_mask(others, _end(ids, others))[ids]
    return found


def index_of(ids: I32, others: I32) -> I32:
    """Return the row (n,) of each id in the sorted others, -1 where it is none of them."""
    if not len(others):
        return np.full(len(ids), -1, np.int32)
    first = others[0] - 1
    rows = np.full(others[-1] - first + 2, -1, np.int32)
    rows[others - first] = np.arange(len(others), dtype=np.int32)
    return np.asarray(rows[np.clip(ids - first, 0, len(rows) - 1)], np.int32)


def _end(*parts: I32) -> int:
    return max((int(part.max()) + 1 for part in parts if len(part)), default=0)


def _membership_mask(ids: I32, size: int) -> Bool:
    marked = np.zeros(size, np.bool_)
    marked[ids] = True
    return marked
