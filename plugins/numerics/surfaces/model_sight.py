"""What a dense model takes in of a frame."""

from __future__ import annotations

from typing import NamedTuple

from trihedron.pipeline.core.types import F32, F64, U8, Frame, Pose
from trihedron.plugins.numerics.depth.reduction import lens_of, reduced, step_to
from trihedron.plugins.numerics.surfaces.block_model import Lens, lens_at


class Sight(NamedTuple):
    """A frame reduced to about a width, with its lens (fx, fy, cx, cy) and its camera at its pose."""

    depth_m: F32  # (h, w), 0 = none
    color: U8  # (h, w, 3)
    lens: F64
    camera: Lens


def sight_of(frame: Frame, pose: Pose, width: int) -> Sight:
    """The frame as the model sees it."""
    step = step_to(frame, width)
    lens = lens_of(frame, step)
    return Sight(*reduced(frame.depth_m, frame.color, step), lens, lens_at(lens, pose.T_world_camera))
