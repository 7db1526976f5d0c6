"""The files of a surface in a run folder: surface.ply, and surface.json, in which commands keep how far it is from the true one."""

from __future__ import annotations

from pathlib import Path

from trihedron.pipeline.core.registry import register_files
from trihedron.pipeline.core.types import Surface
from trihedron.plugins.surface.ply import triangle_planes, write_ply

SURFACE, SURFACE_ERRORS = "surface.ply", "surface.json"
WORLD = "metres; the world of trajectory.txt: the first camera's frame, x right, y down, z forward"


@register_files("surface", (SURFACE, SURFACE_ERRORS))
def write_surface(out: Path, surface: Surface) -> list[str]:
    """Write surface.ply, in the world of trajectory.txt, and return a line that describes it."""
    write_ply(out / SURFACE, surface.vertices_m, surface.colors, surface.triangles, triangle_planes(surface), WORLD)
    if len(surface.triangles) == 0:
        return ["the surface is empty: no tracked frame showed enough of one"]
    planar, planes = surface.instances >= 0, len(surface.plane_ids)
    return [f"surface: {len(surface.triangles)} triangles, {planar.sum()} of them in {planes} planes of {surface.areas_m2.sum():.1f} m²"]
