"""Kernels of `segment_completion.py`: detected segments merged, placed on the edge and selected."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, U8
from trihedron.plugins.lines.collinear_merging_kernels import merge_collinear
from trihedron.plugins.lines.edge_placement_kernels import refine_on_edge


class SegmentRules(NamedTuple):
    """Rules for merging, selecting and placing segments."""

    angle: float  # rad, difference of direction of fragments of one edge
    offset_px: float  # their distance across
    gap_px: float  # and along
    least_px: float  # length of the shortest segment
    border_px: float  # a segment nearer than this to the image's border all along is the border
    reach_px: int  # half-width of the search for the edge across the segment


@kernel
def place_segments(image: U8, found: F64, scale: float, rules: SegmentRules, most: int) -> F32:
    """Merge the segments (m, 4) `found` on the image at `scale` and place them on the edge of the full image, twice, because placing makes fragments
    of one edge collinear. Returns the `most` longest, (n, 2, 2), longest first."""
    angle, offset_px, gap_px, least_px, border_px, reach_px = rules
    lines, out = np.empty((len(found), 4)), np.empty((0, 2, 2), np.float32)
    for i in range(len(found)):
        for j in range(4):
            lines[i, j] = (found[i, j] + 0.5) / scale - 0.5
    for share in (1.0, 0.5):
        lines = merge_collinear(lines, share * angle, share * offset_px, gap_px)[: 2 * most]
        out = refine_on_edge(image, _select_segments(lines, least_px, border_px, image.shape[1], image.shape[0]), reach_px, 2.0)
        lines = out.astype(np.float64).reshape(-1, 4)
    return out[:most].copy()


@kernel
def _select_segments(lines: F64, least_px: float, border_px: float, width: int, height: int) -> F64:
    """Select segments that are long enough, and not the border of the image (or of what the sensor's registration left of it)."""
    out, n = np.empty((len(lines), 4)), 0
    right, bottom = width - 1 - border_px, height - 1 - border_px
    for i in range(len(lines)):
        x0, y0, x1, y1 = lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3]
        inside = not (max(x0, x1) < border_px or min(x0, x1) > right or max(y0, y1) < border_px or min(y0, y1) > bottom)
        if inside and np.hypot(x1 - x0, y1 - y0) >= least_px:
            out[n, 0], out[n, 1], out[n, 2], out[n, 3] = x0, y0, x1, y1
            n += 1
    return out[:n]
