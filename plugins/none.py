"""The empty value of each slot, for where nothing is to be computed. `pose=none` does compute a pose: it lies in the folder of its slot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import (
    Building,
    Correction,
    Frame,
    Keypoints,
    LineSegments,
    Map,
    Normals,
    Planes,
    Pose,
    PredictedView,
    Segments,
    Surface,
)


@register("normals", "none")
@dataclass(frozen=True)
class NoNormals:
    """A grid of NaN: what the rest of the system does without normals (and so without planes found from them)."""

    stride: Annotated[int, Range(1, 8)] = 2  # px between cells of the grid

    def __call__(self, frame: Frame) -> Normals:
        """Return no normals."""
        h, w = (-(-side // self.stride) for side in frame.depth_m.shape)
        return Normals(frame.index, frame.stamp_ns, np.full((h, w, 3), np.nan, np.float32), self.stride)


@register("keypoints", "none")
@dataclass(frozen=True)
class NoKeypoints:
    """A value without rows: what the rest of the system does without points."""

    descriptor_bytes: Annotated[int, Range(1, 4096)] = 32  # length of the (absent) descriptors, that of ORB

    def __call__(self, frame: Frame) -> Keypoints:
        """Return no key points."""
        return Keypoints(
            index=frame.index,
            stamp_ns=frame.stamp_ns,
            pixels=np.zeros((0, 2), np.float32),
            points_m=np.zeros((0, 3), np.float32),
            sigma_px=np.zeros(0, np.float32),
            sigma_m=np.zeros(0, np.float32),
            octaves=np.zeros(0, np.uint8),
            angles_deg=np.zeros(0, np.float32),
            descriptors=np.zeros((0, self.descriptor_bytes), np.uint8),
        )


@register("lines", "none")
@dataclass(frozen=True)
class NoLines:
    """A value without rows: what the rest of the system does without lines."""

    descriptor_bytes: Annotated[int, Range(1, 4096)] = 32  # length of the (absent) descriptors, that of binary LBD

    def __call__(self, frame: Frame) -> LineSegments:
        """Return no segments."""
        return LineSegments(frame.index, frame.stamp_ns, np.zeros((0, 2, 2), np.float32), np.zeros((0, self.descriptor_bytes), np.uint8))


@register("segments", "none")
@dataclass(frozen=True)
class NoSegments:
    """A value without rows, whatever lines were found: what the rest of the system does without them."""

    def __call__(self, lines: LineSegments) -> Segments:
        """Return no segments; their descriptors have the length of the lines'."""
        return Segments(
            index=lines.index,
            stamp_ns=lines.stamp_ns,
            endpoints_px=np.zeros((0, 2, 2), np.float32),
            endpoints_m=np.zeros((0, 2, 3), np.float32),
            covariance_m2=np.zeros((0, 2, 3, 3), np.float32),
            descriptors=np.zeros((0, lines.descriptors.shape[1]), np.uint8),
        )


@register("planes", "none")
@dataclass(frozen=True)
class NoPlanes:
    """A value without rows and all labels 0: what the rest of the system does without planes."""

    samples: PositiveInt = 48  # points of the (absent) regions

    def __call__(self, normals: Normals) -> Planes:
        """Return no planes."""
        return Planes(
            index=normals.index,
            stamp_ns=normals.stamp_ns,
            coefficients=np.zeros((0, 4)),
            covariance=np.zeros((0, 3, 3)),
            moments=np.zeros((0, 4, 4)),
            pixels=np.zeros(0, np.int32),
            samples_m=np.zeros((0, self.samples, 3), np.float32),
            labels=np.zeros(normals.normals.shape[:2], np.uint8),
            stride=normals.stride,
        )


@register("map", "none")
@dataclass(frozen=True)
class NoMap:
    """Skip mapping: every pose is relative to the previous frame alone."""

    def __call__(self, pose: Pose) -> Map | None:
        """Return None."""
        return None

    def localising(self) -> NoMap:
        """Return itself."""
        return self


@register("bundle", "none")
@dataclass(frozen=True)
class NoBundle:
    """The map stays as tracking made it."""

    def __call__(self, map: Map) -> Correction | None:
        """Return None."""
        return None


@register("loop", "none")
@dataclass(frozen=True)
class NoLoop:
    """Skip loop closing."""

    def __call__(self, map: Map) -> Correction | None:
        """Return None."""
        return None


@register("relocalise", "none")
@dataclass(frozen=True)
class NoRelocalisation:
    """Skip relocalisation: a lost camera is tracked again only near its last pose."""

    def __call__(self, map: Map | None) -> Pose | None:
        """Return None."""
        return None


@register("model", "none")
@dataclass(frozen=True)
class NoModel:
    """There is no predicted view to track against."""

    def __call__(self, frame: Frame) -> PredictedView | None:
        """Return None."""
        return None


@register("surface", "none")
@dataclass(frozen=True)
class NoSurface:
    """A mesh without triangles; the state is the last pose, whose index and stamp the mesh bears."""

    def start(self) -> Pose | None:
        """Return None: no frame was seen."""
        return None

    def add(self, state: Pose | None, pose: Pose) -> Pose | None:
        """Remember the frame."""
        return pose

    def finish(self, state: Pose | None, map: Map | None) -> Surface:
        """Return a mesh without vertices, triangles and planes."""
        index, stamp_ns = (state.index, state.stamp_ns) if state is not None else (0, 0)
        return Surface.empty(index, stamp_ns)


@register("building", "none")
@dataclass(frozen=True)
class NoBuilding:
    """A plan without elements; the state is the last pose, whose index and stamp the plan bears."""

    def start(self) -> Pose | None:
        """Return None: no frame was seen."""
        return None

    def add(self, state: Pose | None, pose: Pose) -> Pose | None:
        """Remember the frame."""
        return pose

    def finish(self, state: Pose | None, map: Map | None) -> Building:
        """Return a plan without storeys, walls, rooms and openings."""
        index, stamp_ns = (state.index, state.stamp_ns) if state is not None else (0, 0)
        return Building.empty(index, stamp_ns, "no building was asked for")
