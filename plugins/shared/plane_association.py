"""Which observed plane region belongs to which known plane (section III-A, with the mean distance instead of the minimum)."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.linalg import constant
from trihedron.plugins.shared.plane_association_kernels import associated


def associate_planes(
    coefficients_a: F64,
    samples_a: F32,
    coefficients_b: F64,
    samples_b: F32,
    max_angle_deg: float,
    max_distance_m: float,
    many_to_one: bool = False,
) -> I32:
    """Pairs (row of a, row of b), (p, 2) sorted by a, that are the same plane seen from the same side.

    `coefficients_*` (n, 4), (m, 4) and `samples_*` (n, s, 3), (m, r, 3; NaN padded) are all in one frame, metres. A pair passes when its normals
    differ by at most `max_angle_deg` (opposite normals are the two faces of a thin wall: no pair) and the *mean* distance of the samples of one
    region to the other plane, the better-conditioned way round, is at most `max_distance_m`; the minimum over points would merge parallel
    planes that touch anywhere. Among those the one with the smallest `distance / max_distance_m + 1 - overlap` wins, overlap being the share of
    a's samples near samples of b. A row of a appears once; a row of b too, unless `many_to_one` (a wall seen in two pieces)."""
    return associated(
        constant(coefficients_a, np.float64), constant(samples_a, np.float32),
        np.array(coefficients_b, np.float64, order="C"), np.array(samples_b, np.float32, order="C"),
        float(np.cos(np.radians(max_angle_deg))), float(max_distance_m), many_to_one,
    )  # fmt: skip
