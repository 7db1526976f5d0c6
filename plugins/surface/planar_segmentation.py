"""The triangles of a dense mesh that lie in planes: those of the map first, then planes that only the mesh shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import AcuteDeg, NonNegativeFloat, NonNegativeInt, PositiveFloat, Range, check_increasing
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.surface.fused_volume import VolumeOptions
from trihedron.plugins.surface.half_edges import triangle_areas
from trihedron.plugins.surface.half_edges_kernels import triangle_components
from trihedron.plugins.surface.planar_segmentation_kernels import (
    add_rim,
    curvature_kernel,
    enclosing_planes,
    grow_kernel,
    least_neighbour_cosine,
    on_planes,
    plane_through,
    remove_steps,
)
from trihedron.plugins.surface.plane_axes import plane_axes


@dataclass(frozen=True)
class PlanarOptions(VolumeOptions):
    """Options of planes as polygons: those of the volume, and what is flat in its mesh."""

    distance_m: PositiveFloat = 0.012  # of a vertex from its plane
    angle_deg: AcuteDeg = 25.0  # between the mesh's normal there and the plane's
    rim_m: PositiveFloat = 0.03  # of a vertex from its plane in the rounded rim about it
    rim: NonNegativeInt = 4  # triangles wide
    area_m2: PositiveFloat = 0.02  # of the smallest planar part
    bend_per_m: PositiveFloat = 0.8  # curvature above which a part is not flat
    snap_m: PositiveFloat = 0.05  # how far a vertex may be moved onto the line or the point where planes meet
    outline_m: NonNegativeFloat = 0.02  # error allowed to an outline
    hole_m2: NonNegativeFloat = 0.01  # a hole in a plane's mesh, with nothing in it, that is smaller is closed
    texel_m: Annotated[float, Range(0.001)] = 0.015  # of the picture of the planes

    def __post_init__(self) -> None:
        super().__post_init__()
        check_increasing(self, "distance_m", "rim_m")


# Which triangles of a dense mesh lie in planes: those of the map first, then planes that only the mesh shows.


def planar_labels(vertices: F64, normals: F64, triangles: I32, opposite: I32, planes: F64, options: PlanarOptions) -> tuple[I32, F64]:
    """(t,) row of the plane each triangle lies in, -1 for none, and the planes (p, 4): the given (n, 4), then those found in the mesh, fitted to
    it."""
    cosine = float(np.cos(np.radians(options.angle_deg)))
    turned = normals[triangles].mean(axis=1)
    turned /= np.maximum(np.linalg.norm(turned, axis=1), 1e-12)[:, None]
    area, middle = triangle_areas(vertices, triangles), vertices[triangles].mean(axis=1)
    labels = on_planes(vertices, triangles, turned, planes, options.distance_m, cosine)
    labels = _remove_small_or_curved(labels, middle, opposite, area, planes, options)
    seeds = np.argsort(-np.abs(least_neighbour_cosine(turned, opposite)), kind="stable")
    grown, found = grow_kernel(seeds, labels, len(planes), middle, turned, area, opposite, options.distance_m, cosine, options.area_m2)
    planes = np.concatenate([planes, found])
    labels = _remove_small_or_curved(grown, middle, opposite, area, planes, options)
    labels = _merge_planes(labels, middle, area, opposite, planes, options.distance_m)
    planes = _fit_planes(labels, middle, area, planes)
    for _ in range(options.rim):
        labels = add_rim(labels, vertices, triangles, turned, opposite, planes, options.rim_m)
    labels = remove_steps(labels, triangles, len(vertices), planes, np.asarray(np.bincount(labels + 1, area, len(planes) + 1), np.float64)[1:])
    labels = _fill_holes(labels, vertices, triangles, opposite, planes, options)
    return _remove_small_or_curved(labels, middle, opposite, area, planes, options), planes


def _merge_planes(labels: I32, middle: F64, area: F64, opposite: I32, planes: F64, distance: float) -> I32:
    """Planes that touch, and of which the larger one fits the smaller one's triangles within the distance (RMS), are one, such as a floor that was
    mapped twice. The larger keeps its identity."""
    h = np.flatnonzero(opposite >= 0)
    here, there = labels[h // 3], labels[opposite[h] // 3]
    seams = (here >= 0) & (there >= 0) & (here != there)
    pairs = np.unique(np.stack([here[seams], there[seams]], axis=1), axis=0)
    total = np.bincount(labels + 1, area, len(planes) + 1)[1:]
    out, stands_for = labels.copy(), np.arange(len(planes))
    for small in np.argsort(total, kind="stable"):
        beside = np.unique(stands_for[pairs[stands_for[pairs[:, 0]] == small, 1]])
        rows = np.flatnonzero(out == small)
        beside = beside[(total[beside] >= total[small]) & (beside != small)]
        for large in beside[np.argsort(-total[beside], kind="stable")]:
            off = matmul(middle[rows], planes[large, :3]) + planes[large, 3]
            if matmul(planes[large, :3], planes[small, :3]) > 0.9 and np.average(off**2, weights=area[rows]) <= distance**2:
                out[rows], stands_for[stands_for == small] = large, large
                total[large] += total[small]
                break
    return out


def _fit_planes(labels: I32, middle: F64, area: F64, planes: F64) -> F64:
    """The planes, each moved to its triangles by least squares."""
    order = np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels[order], np.arange(len(planes) + 1))
    out = planes.copy()
    for p in range(len(planes)):
        rows = order[bounds[p] : bounds[p + 1]].astype(np.int32)
        if len(rows) >= 3:
            out[p, :3], out[p, 3] = plane_through(middle, area, rows, planes[p, :3].copy())
    return out


def _remove_small_or_curved(labels: I32, middle: F64, opposite: I32, area: F64, planes: F64, options: PlanarOptions) -> I32:
    """The labels without the connected parts that are too small, or bent."""
    parts, count = triangle_components(opposite, labels)
    total = np.bincount(parts, area, count)
    bend = part_curvatures(parts, count, labels, middle, area, planes)
    return np.where((total[parts] >= options.area_m2) & (bend[parts] <= options.bend_per_m), labels, -1).astype(np.int32)


def _fill_holes(labels: I32, vertices: F64, triangles: I32, opposite: I32, planes: F64, options: PlanarOptions) -> I32:
    """Small holes in a planar part, all about it and near its plane, belong to it."""
    parts, count = triangle_components(opposite, labels)
    around = enclosing_planes(parts, count, labels, opposite)
    near = np.ones(count, np.bool_)
    area = np.bincount(parts, triangle_areas(vertices, triangles), count)
    hole = (around >= 0) & (area < options.area_m2)
    rows = np.flatnonzero((labels < 0) & hole[parts])
    plane = planes[around[parts[rows]]]
    off = np.abs(np.einsum("tkj,tj->tk", vertices[triangles[rows]], plane[:, :3]) + plane[:, 3:]).max(axis=1)
    near[parts[rows[off > options.rim_m]]] = False
    rows = rows[near[parts[rows]]]
    out = labels.copy()
    out[rows] = around[parts[rows]]
    return out


# How curved the parts of a mesh are.


def part_curvatures(parts: I32, count: int, labels: I32, middle: F64, area: F64, planes: F64) -> F64:
    """(count,) larger principal curvature (1/m) of the quadric of least squares over each part's plane; 0 for parts without one."""
    frames = np.array([np.column_stack([plane_axes(plane), plane[:3]]) for plane in planes]).reshape(-1, 3, 3)
    return curvature_kernel(parts, count, labels, middle, area, frames)
