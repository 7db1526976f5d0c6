"""Rooms whose walls are upright and at any angle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64
from trihedron.plugins.building.common import UPRIGHT_DEG, Evidence, Storey, tall_m
from trihedron.plugins.building.common_layout import AXES, Layout

SNAP_DEG = 3.0  # a direction nearer to an axis of the building is that axis
BINS = 180  # of 1°


@register("building", "atlanta_layout")
@dataclass(frozen=True)
class AtlantaLayout(Layout):
    """Extend `manhattan_layout` by further directions of walls: the peaks of the upright regions' normals about the vertical (Schindler, Dellaert,
    CVPR 2004, "Atlanta world"). An edge along none of the axes is turned to its own points."""

    apart_deg: Annotated[float, Range(2, 45)] = 6.0  # between directions
    least_m2: PositiveFloat = 1.0  # of tall points of a direction

    def _directions(self, evidence: Evidence, storey: Storey) -> F64:
        """Return the axes and the other peaks."""
        tall = (np.abs(evidence.normals[:, 2]) < np.sin(np.radians(UPRIGHT_DEG))) & (evidence.points[:, 2] - storey.bottom_m > tall_m(storey))
        angles = np.mod(np.degrees(np.arctan2(evidence.normals[tall, 1], evidence.normals[tall, 0])), 180.0)
        weight = evidence.area_m2[tall]
        histogram = np.bincount(angles.astype(int) % BINS, weight, BINS)
        smooth = sum((np.roll(histogram, k) for k in (-2, -1, 1, 2)), histogram)
        found = [0.0, 90.0]
        for best in np.argsort(-smooth, kind="stable"):
            near = np.abs(_turned(angles, best + 0.5)) < 2.5
            if smooth[best] < self.least_m2 or not weight[near].any():
                break
            angle = best + 0.5 + float(np.average(_turned(angles[near], best + 0.5), weights=weight[near]))
            if all(abs(float(_turned(np.array(angle), other))) > max(self.apart_deg, SNAP_DEG) for other in found):
                found.append(angle)
        more = np.radians(found[2:])
        one = np.stack([np.cos(more), np.sin(more)], axis=1)
        return np.concatenate([AXES, one, -one])


def _turned(angles: F64, middle: float) -> F64:
    """Return by how much directions modulo 180° are turned from another, in degrees."""
    return np.asarray(np.mod(angles - middle + 90.0, 180.0) - 90.0)
