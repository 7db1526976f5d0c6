"""Kernels that grow labelled planar regions to their borders."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot
from trihedron.pipeline.core.types import F64, I32, U8
from trihedron.plugins.shared.depth_image_kernels import Grid


@kernel
def grow_regions(labels: U8, planes: F64, grid: Grid, gate: float, reach: int, cos_cone: float) -> U8:
    """Grow labels (h, w) ring by ring into unlabelled cells whose depth is within `gate` σ of the neighbouring region's q; returns a copy.

    A cell goes to the plane that explains it best. For `reach` rings normals do not count (they are blurred or missing near a border); beyond, a
    normal must be missing or lie within the cone."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    out = labels.copy()
    offered = np.zeros((h, w), np.uint8)
    residual = np.empty((h, w), np.float32)
    flat, flat_offered = out.ravel(), offered.ravel()
    frontier = _border(labels)
    nearby = np.empty(h * w, np.int32)
    unit = np.empty_like(planes)
    for k in range(len(planes)):
        length = max(np.sqrt(dot(planes[k], planes[k])), 1e-12)
        for a in range(3):
            unit[k, a] = -planes[k, a] / length
    ring = 0
    while len(frontier) > 0:
        m = 0
        for i in frontier:
            r = i // w
            c = i - r * w
            label = out[r, c]
            k = label - 1
            for s, d in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)):
                if s < 0 or s >= h or d < 0 or d >= w or out[s, d] != 0 or rho[s, d] <= 0.0:
                    continue
                p = rho[s, d]
                e = abs(planes[k, 0] * rays_x[d] + planes[k, 1] * rays_y[s] + planes[k, 2] - p) / sigma[s, d]
                if e > gate:
                    continue
                if ring >= reach:
                    facing = normals[s, d, 0] * unit[k, 0] + normals[s, d, 1] * unit[k, 1] + normals[s, d, 2] * unit[k, 2]
                    if facing < cos_cone:
                        continue
                if offered[s, d] == 0:
                    nearby[m] = s * w + d
                    m += 1
                elif e > residual[s, d] or (e == residual[s, d] and label > offered[s, d]):
                    continue
                offered[s, d], residual[s, d] = label, e
        frontier = nearby[:m].copy()
        for i in frontier:
            flat[i] = flat_offered[i]
        ring += 1
    return out


@kernel
def _border(labels: U8) -> I32:
    """Flat numbers of the labelled cells next to unlabelled ones."""
    h, w = labels.shape
    out, n = np.empty(h * w, np.int32), 0
    beside = np.empty(w, np.bool_)
    for r in range(h):
        here, above, below = labels[r], labels[max(r - 1, 0)], labels[min(r + 1, h - 1)]
        for c in range(w):
            beside[c] = (here[c] > 0) & ((above[c] == 0) | (below[c] == 0))
        for c in range(w - 1):
            beside[c] |= (here[c] > 0) & (here[c + 1] == 0)
        for c in range(1, w):
            beside[c] |= (here[c] > 0) & (here[c - 1] == 0)
        for c in range(w):
            if beside[c]:
                out[n] = r * w + c
                n += 1
    return out[:n]
