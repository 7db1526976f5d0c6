"""3D lines by a robust fit to the depth along image segments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveShare, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments, Segments
from trihedron.plugins.segments.ransac_kernels import lift_segments


@register("segments", "ransac")
@dataclass(frozen=True)
class Ransac:
    """Sample consensus over the depth along each segment, then weighted least squares (paper, section III-A).

    Every sample has a depth noise of its own, the acceptance is a share of the samples that were taken, and hypotheses are enumerated, not drawn.
    A segment on a depth edge takes the nearer surface, whose border it is. Rows without a 3D line are NaN; their image segment stays usable."""

    samples: Annotated[int, Range(2)] = 64  # most depth samples along a segment
    side_px: Annotated[int, Range(0, 20)] = 3  # searched across the segment for the nearer surface
    edge: NonNegativeFloat = 0.02  # a step above gate · σ_z + edge · z parts two surfaces
    gate: PositiveFloat = 3.0  # σ_z within which a sample is an inlier
    share: PositiveShare = 0.5  # of the samples with depth that must be inliers
    min_inliers: Annotated[int, Range(2)] = 10
    sigma_px: PositiveFloat = 0.5  # of the end points across and along the segment
    correlation_px: NonNegativeFloat = 4.0  # samples nearer than this do not count as independent
    bias: NonNegativeFloat = 0.3  # σ_z common to all samples of a line

    def __call__(self, frame: Frame, lines: LineSegments) -> Segments:
        """One row per row of `lines`."""
        camera = frame.camera
        points, covariance = lift_segments(
            frame.depth_m,
            lines.endpoints_px,
            (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)),
            camera.depth_noise.coefficients,
            self.samples,
            self.side_px,
            self.edge,
            self.gate,
            self.share,
            self.min_inliers,
            self.sigma_px,
            self.correlation_px,
            self.bias,
        )
        return Segments(frame.index, frame.stamp_ns, lines.endpoints_px, points, covariance, lines.descriptors)
