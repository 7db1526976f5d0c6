"""Final steps of every plane detector: grow regions to their borders, merge them, fit by weighted least squares, report with covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import inv, matmul, solve
from trihedron.pipeline.core.options import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.types import F64, I32, U8, Frame, Normals, Planes
from trihedron.plugins.planes.curvature_kernels import drop_engulfed, normal_statistics
from trihedron.plugins.planes.plane_report_kernels import plane_report
from trihedron.plugins.planes.region_cells_kernels import solve_symmetric
from trihedron.plugins.planes.region_merging_kernels import grow_and_merge
from trihedron.plugins.planes.region_sums_kernels import largest_regions
from trihedron.plugins.planes.trimmed_fit_kernels import MAX_REGIONS
from trihedron.plugins.shared.depth_image_kernels import Grid, cell_inverse_depths, cell_rays

EDGE, EDGE_M = 0.04, 0.02  # a step above EDGE z + EDGE_M within a cell's pixels: no depth there
FACING = 0.5  # share of a region's cells that must have a normal within two cones of its own
BIASES = 4.5  # biases of one σ_z across a region that its normals may turn by at any rate
Sums = tuple[F64, F64, F64, I32]  # of each region's core, as from `accumulate`


@dataclass(frozen=True)
class RegionOptions:
    """Options of every detector: a plugin finds the core of each region, `complete_planes` makes Planes of them."""

    cone_deg: Annotated[float, Range(above=0, high=45)] = 15.0  # normals of one plane lie within this of it
    gate: PositiveFloat = 3.0  # σ_z of a member's depth
    turn: PositiveFloat = 0.5  # a region whose normals turn by more than this share of the cone's half angle is curved
    border_px: NonNegativeInt = 16  # grown into whatever the normals say
    merge: NonNegativeFloat = 0.3  # rms distance, in σ_z, of a region from the common plane of the two, noise apart
    gap_px: NonNegativeInt = 8  # between regions that may be one
    min_pixels: Annotated[int, Range(16)] = 1000  # smallest region
    planes: Annotated[int, Range(1, MAX_REGIONS)] = 24  # most, the largest
    samples: PositiveInt = 48  # points spread over a region
    correlation_px: Annotated[float, Range(1)] = 8.0  # side of the square that counts as one independent depth, where the residuals cannot tell
    tiles: Annotated[int, Range(4)] = 16  # squares a region is cut into to see how its residuals are correlated
    bias: NonNegativeFloat = 0.1  # σ_z common to all depths of a region: a real sensor's depth is bent (fr3 of TUM: 0.1 to 0.3 track best)


def grid_of(frame: Frame, normals: Normals) -> Grid:
    """Average the frame's inverse depths on the grid of the normals."""
    camera = frame.camera
    rho, sigma, count = cell_inverse_depths(frame.depth_m, normals.stride, EDGE, EDGE_M, camera.depth_noise.coefficients)
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    rays_x, rays_y = cell_rays(rho.shape[0], rho.shape[1], normals.stride, intrinsics)
    return Grid(rho, sigma, count, rays_x, rays_y, normals.normals)


def least_cells(options: RegionOptions, stride: int) -> int:
    """Cells a region's core must have: half of what the smallest region covers."""
    return options.min_pixels // (2 * stride * stride) + 1


def complete_planes(options: RegionOptions, core: U8, q: F64, grid: Grid, frame: Frame, stride: int, flat: bool = True) -> Planes:
    """Grow, merge and fit the regions whose core cells are labelled (h, w) and whose planes are q (k, 3). A detector that did not use the normals
    passes `flat` False: curved regions are dropped."""
    gap, cos_cone = max(options.gap_px // stride, 1), math.cos(2.0 * math.radians(options.cone_deg))
    labels, owner, sums = grow_and_merge(
        core, q, grid, options.gate, options.border_px // stride, cos_cone, gap, options.merge, options.correlation_px**2
    )
    if not flat:
        owner = _drop_curved(options, owner, labels, sums, grid, gap)
    return _report(options, labels, core, owner, sums, grid, frame, stride)


def _drop_curved(options: RegionOptions, owner: I32, labels: U8, sums: Sums, grid: Grid, gap: int) -> I32:
    """Set the label of each region (k + 1,) to 0 where the normals, if there are any, show that it is curved."""
    if np.isnan(grid.normals[..., 0]).all():
        return owner
    cone, merged = float(np.radians(options.cone_deg)), owner[labels]
    q = np.array([solve_symmetric(A, b)[1] for A, b in zip(sums[0], sums[1])]).reshape(-1, 3)
    turns, biases, share = normal_statistics(merged, q, grid, float(np.cos(2.0 * cone)), 2)
    good = (share >= FACING) & (turns <= np.maximum(options.turn * cone, BIASES * biases))
    good = drop_engulfed(merged, grid.rho, good, gap)
    return np.where(np.concatenate([[False], good])[owner], owner, 0).astype(np.int32)


def _report(options: RegionOptions, labels: U8, core: U8, owner: I32, sums: Sums, grid: Grid, frame: Frame, stride: int) -> Planes:
    """Report the largest regions, largest first; `owner` is the region of each label, 0 = none."""
    numbered, number, ranked, area = largest_regions(labels, owner, grid.count, options.min_pixels, options.planes)
    A, b, moments, n = (total[ranked] for total in sums)
    q = np.asarray(solve(A, b[..., None])[..., 0], np.float64)
    coefficients, J, excess, samples = plane_report(
        numbered, core, number, q, grid, options.tiles, options.correlation_px**2, 2.0, options.samples, 400
    )
    variance = excess + options.bias**2 * n  # over that of the least-squares fit to n independent depths, `A⁻¹`
    return Planes(
        index=frame.index,
        stamp_ns=frame.stamp_ns,
        coefficients=coefficients,
        covariance=matmul(J, inv(A) * variance[:, None, None], np.swapaxes(J, -1, -2)),
        moments=np.asarray(moments, np.float64),
        pixels=area,
        samples_m=samples,
        labels=numbered,
        stride=stride,
    )
