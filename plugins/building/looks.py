"""Looks at a face: at which heights of its columns views read it, and at which they read what is behind its line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import Face
from trihedron.plugins.building.free_space import CELL_M, LEVEL_M
from trihedron.plugins.building.free_space_kernels import LEVELS
from trihedron.plugins.building.levels import Storey
from trihedron.plugins.building.looks_kernels import looks_kernel

NEAREST_M = 0.3  # of an eye to a face
MARGIN = np.array([0.03, 0.004, 0.08, 0.06])  # m, 1/m, m, m: two standard deviations of a Kinect and 3 cm, at most, and between on a face and behind


@dataclass(frozen=True)
class Looks:
    """Numbers of views that read a face, `on`, and what is behind its line, `beyond`, at its columns and levels (k, LEVELS)."""

    on: I32
    beyond: I32


def looks_at(face: Face, evidence: Evidence, storey: Storey, inverses: list[F64]) -> Looks:
    """Count the looks of all views, whose poses' inverses `T_camera_building` are given, at a face."""
    columns = len(face.count)
    line = (face.start_m + (np.arange(columns) + 0.5) * CELL_M)[:, None] * face.along + face.offset_m * face.normal
    heights = np.asarray(storey.bottom_m + (np.arange(LEVELS) + 0.5) * LEVEL_M, np.float64)
    on, beyond = np.zeros((columns, LEVELS), np.int32), np.zeros((columns, LEVELS), np.int32)
    for row in np.nonzero(matmul(evidence.eyes[:, :2], face.normal) - face.offset_m >= NEAREST_M)[0]:
        view, T = evidence.views[row], inverses[row]
        looks_kernel(view.depth_m, view.camera.intrinsics, T, line, face.normal, heights, MARGIN, on, beyond)
    return Looks(on, beyond)
