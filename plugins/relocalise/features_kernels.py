"""Kernel of `features.py`: share of a frame's planes and lines explained by the map at each hypothetical position."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32

BIN_M = 0.03  # of the votes
NEAR_M = 1.5 * BIN_M  # within which a vote belongs to a candidate


@kernel
def explained_share(
    places: F64, sides: I32, offsets: F64, areas: F64, axes: I32, spans: F64, across: F64, lengths: F64,
    known_sides: I32, known_offsets: F64, known_axes: I32, known_spans: F64, known_across: F64,
) -> F64:  # fmt: skip
    """Return the share (n,) of the areas plus that of the lengths that lie on a known plane or line with the camera at each of the places (n, 3)."""
    out = np.zeros(len(places))
    start = np.searchsorted(known_axes, np.arange(4))
    for k in range(len(places)):
        for i in range(len(sides)):
            place = offsets[i] + places[k, sides[i] % 3]
            for j in range(len(known_sides)):
                if known_sides[j] == sides[i] and abs(known_offsets[j] - place) < NEAR_M:
                    out[k] += areas[i]
                    break
        for i in range(len(axes)):
            a = axes[i]
            u, v = across[i, 0] + places[k, (a + 1) % 3], across[i, 1] + places[k, (a + 2) % 3]
            low, high = spans[i, 0] + places[k, a], spans[i, 1] + places[k, a]
            first = start[a] + np.searchsorted(known_across[start[a] : start[a + 1], 0], u - NEAR_M)
            for j in range(first, start[a + 1]):
                if known_across[j, 0] > u + NEAR_M:
                    break
                if abs(known_across[j, 1] - v) > NEAR_M:
                    continue
                if min(high, known_spans[j, 1]) - max(low, known_spans[j, 0]) > 0.3 * min(high - low, known_spans[j, 1] - known_spans[j, 0]):
                    out[k] += lengths[i]
                    break
    return out
