"""3D lines by a robust fit to the depth along image segments."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments, Segments
from trihedron.plugins.segments.ransac_kernels import lift_segments
from trihedron.plugins.shared.depth_image import noise_coefficients


@register("segments", "ransac")
@dataclass(frozen=True)
class Ransac:
    """Sample consensus over the depth along each segment, then weighted least squares (paper, section III-A).

    Every sample has a depth noise of its own, the acceptance is a share of the samples that were taken, and hypotheses are enumerated, not drawn.
    A segment on a depth edge takes the nearer surface, whose border it is. Rows without a 3D line are NaN; their image segment stays usable."""

    samples: int = 64  # most depth samples along a segment
    side_px: int = 3  # searched across the segment for the nearer surface
    edge: float = 0.02  # a step above gate · σ_z + edge · z parts two surfaces
    gate: float = 3.0  # σ_z within which a sample is an inlier
    share: float = 0.5  # of the samples with depth that must be inliers
    min_inliers: int = 10
    sigma_px: float = 0.5  # of the end points across and along the segment
    correlation_px: float = 4.0  # samples nearer than this do not count as independent
    bias: float = 0.3  # σ_z common to all samples of a line

    def __post_init__(self) -> None:
        if self.samples < 2 or self.min_inliers < 2:
            raise ValueError("samples, min_inliers: must be at least 2")
        if not 0 <= self.side_px <= 20:
            raise ValueError("side_px: must be 0 to 20")
        if self.edge < 0.0 or self.gate <= 0.0 or not 0.0 < self.share <= 1.0:
            raise ValueError("edge, gate, share: edge at least 0, gate above 0, share in (0, 1]")
        if self.sigma_px <= 0.0 or self.correlation_px < 0.0 or self.bias < 0.0:
            raise ValueError("sigma_px, correlation_px, bias: must not be negative, sigma_px above 0")

    def __call__(self, frame: Frame, lines: LineSegments) -> Segments:
        """One row per row of `lines`."""
        camera = frame.camera
        points, covariance = lift_segments(
            frame.depth_m,
            lines.endpoints_px,
            (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)),
            noise_coefficients(camera.depth_noise),
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
