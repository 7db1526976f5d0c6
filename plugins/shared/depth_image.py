"""Depth at sub-pixel positions, refused where it cannot be trusted."""

from __future__ import annotations

from trihedron.pipeline.core.types import DepthNoise


def noise_coefficients(noise: DepthNoise) -> tuple[float, float, float, float]:
    """The depth noise model as numbers a kernel can take: (a, b, c, floor) of `max(floor, a + b z + c z²)`."""
    return float(noise.a_m), float(noise.b), float(noise.c_per_m), float(noise.floor_m)
