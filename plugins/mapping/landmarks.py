"""Columns of the map's tables."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import I32, Bool, Column, Map, Table

PLACE = Column("f8", (3,), 2.0**-20)  # in the world, to a micrometre: a thousandth of what is known of any
ENDS = Column("f8", (2, 3), PLACE.step)
SHOWN = 2.0**-10  # 1 mm, or 0.06°: what is only compared with limits of centimetres and degrees
OBSERVERS = 16  # most recent keyframes remembered by a landmark, enough for co-visibility; -1 = empty

KEYFRAMES = {
    "index": Column("i4"),  # frame number
    "stamp_ns": Column("i8"),
    "T_world_camera": Column("f8", (4, 4)),
    "covariance": Column("f8", (6, 6)),  # of its pose, see types
    "intrinsics": Column("f8", (4,)),  # fx, fy, cx, cy
    "points": Column("i4", (2,)),  # its rows of the observation tables, half open
    "lines": Column("i4", (2,)),
    "planes": Column("i4", (2,)),
    "submap": Column("i4"),  # poses of different sub-maps are in different worlds
    "alive": Column("?"),
}


def point_columns(descriptor_bytes: int) -> dict[str, Column]:
    """`information` is the inverse covariance of the position (world, 1/m²), good to a few digits and kept as such; `distance_m` and `octave` say at
    which range and scale it was seen."""
    return {
        "position_m": PLACE,
        "information": Column("f4", (3, 3)),
        "descriptor": Column("u1", (descriptor_bytes,)),
        "direction": Column("f4", (3,), SHOWN),  # unit, from the point to the camera that saw it last
        "distance_m": Column("f4", step=SHOWN),
        "octave": Column("u1"),
        **_life(),
    }


def line_columns(descriptor_bytes: int) -> dict[str, Column]:
    """End points in the world with the inverse covariance of each."""
    return {
        "endpoints_m": ENDS,
        "information": Column("f4", (2, 3, 3)),
        "descriptor": Column("u1", (descriptor_bytes,)),
        **_life(),
    }


def plane_columns(samples: int) -> dict[str, Column]:
    """World planes, re-estimated from `moments`, the sum of what each observation is equivalent to (`plane_fusion.equivalent_moments`); n points to
    the side the plane was seen from, d has any sign."""
    return {
        "coefficients": Column("f8", (4,)),
        "covariance": Column("f8", (3, 3)),  # of (a, b, d), see types.Planes
        "moments": Column("f8", (4, 4)),
        "samples_m": Column("f4", (samples, 3), SHOWN),
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
    return Map(
        index=index,
        stamp_ns=stamp_ns,
        revision=0,
        keyframes=Table.empty(KEYFRAMES),
        points=Table.empty(point_columns(point_bytes)),
        lines=Table.empty(line_columns(line_bytes)),
        planes=Table.empty(plane_columns(plane_samples)),
        point_observations=Table.empty(POINT_OBSERVATIONS),
        line_observations=Table.empty(LINE_OBSERVATIONS),
        plane_observations=Table.empty(PLANE_OBSERVATIONS),
    )


# Sets of ids, as sorted rows. Ids lie close together, so marking them beats sorting them.


def distinct(ids: I32) -> I32:
    """(n,) the different ids, sorted."""
    if len(ids) == 0:
        return ids
    first = ids.min()
    marked = np.zeros(ids.max() - first + 1, np.bool_)
    marked[ids - first] = True
    return (np.flatnonzero(marked) + first).astype(np.int32)


def union(a: I32, b: I32) -> I32:
    """(n,) the ids of both, once each and sorted."""
    marked = np.zeros(_end(a, b), np.bool_)
    marked[a] = True
    marked[b] = True
    return np.flatnonzero(marked).astype(np.int32)


def among(ids: I32, others: I32) -> Bool:
    """(n,) which of the ids are among the others."""
    marked = np.zeros(_end(ids, others), np.bool_)
    marked[others] = True
    found: Bool = marked[ids]
    return found


def places(ids: I32, others: I32) -> I32:
    """(n,) the row of each id among the others, which are sorted, -1 where it is none of them."""
    if not len(others):
        return np.full(len(ids), -1, np.int32)
    first = others[0] - 1
    rows = np.full(others[-1] - first + 2, -1, np.int32)
    rows[others - first] = np.arange(len(others), dtype=np.int32)
    return np.asarray(rows[np.clip(ids - first, 0, len(rows) - 1)], np.int32)


def _end(*parts: I32) -> int:
    return max((int(part.max()) + 1 for part in parts if len(part)), default=0)
