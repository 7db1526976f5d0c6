"""The depth noise model for kernels."""

from __future__ import annotations

from trihedron.pipeline.core.types import DepthNoise


def noise_coefficients(noise: DepthNoise) -> tuple[float, float, float, float]:
    """Return the depth noise model as plain numbers: (a, b, c, floor) of `max(floor, a + b z + c z²)`."""
    return float(noise.a_m), float(noise.b), float(noise.c_per_m), float(noise.floor_m)
