"""Blur of an image by the width of its edges (Marziliano et al., ICIP 2002): blurred by a Gaussian of σ, an edge is √(2π) σ wide.

Blur makes all edges wide, a surface whose texture is smooth only its own: so the narrower ones are asked."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, U8
from trihedron.plugins.shared.edge_width_kernels import edge_widths
from trihedron.plugins.shared.quantiles import quantiles

SHARP_PX = 1.2  # median σ of the edges of a camera at rest: optics, colour filter and JPEG make 0.6 to 1.2
NARROW, MEDIAN_OF_NARROW = 0.25, 1.35  # quantile of the widths, and the median by it: 1.27 to 1.56 in five sequences of cameras, sharp or blurred
CONTRAST = 40  # grey levels of an edge
STRIDE_PX = 8  # between the rows, and the columns, that are looked at
LEAST_EDGES = 20  # along rows, and along columns, below which nothing is known


def motion_blur_px(gray: U8) -> float:
    """Return the standard deviation (px) by which an image (h, w) is blurred beyond a sharp one, as the root mean square over both axes: where along
    the camera's way a corner of it is. 0 for an image with few edges."""
    variances = [_variance(widths) for widths in edge_widths(gray, STRIDE_PX, CONTRAST)]
    return float(np.sqrt(np.mean(variances)))


def _variance(widths: F64) -> float:
    """Return the variance (px²) beyond a sharp edge's."""
    if len(widths) < LEAST_EDGES:
        return 0.0
    median = MEDIAN_OF_NARROW * float(quantiles(widths, NARROW))
    return max(median**2 / (2.0 * np.pi) - SHARP_PX**2, 0.0)
