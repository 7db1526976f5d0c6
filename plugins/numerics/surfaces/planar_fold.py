"""What the planar meshes have in common: a dense mesh, and which of it lies in planes."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.types import Map, Surface
from trihedron.plugins.numerics.surfaces.assembly import pictured
from trihedron.plugins.numerics.surfaces.borders import REST
from trihedron.plugins.numerics.surfaces.half_edges import opposite_half_edges, vertex_normals, with_single_fans
from trihedron.plugins.numerics.surfaces.pinholes import without_pinholes
from trihedron.plugins.numerics.surfaces.planar_parts import Flatness, map_planes, numbered, planar_labels
from trihedron.plugins.numerics.surfaces.polygons import flattened
from trihedron.plugins.numerics.surfaces.view_fold import Gathered, VolumeFold


@dataclass(frozen=True)
class PlanarFold(VolumeFold):
    """Fuses all views, finds the planes of the map and others in the mesh, and makes polygons of them."""

    distance_m: float = 0.012  # of a vertex from its plane
    angle_deg: float = 25.0  # between the mesh's normal there and the plane's
    rim_m: float = 0.03  # of a vertex from its plane in the rounded rim about it
    rim: int = 4  # triangles wide
    area_m2: float = 0.02  # of the smallest planar part
    bend_per_m: float = 0.8  # curvature above which a part is not flat
    snap_m: float = 0.05  # how far a vertex may be moved onto the line or the point where planes meet
    outline_m: float = 0.02  # error allowed to an outline
    hole_m2: float = 0.01  # a hole in a plane's mesh, with nothing in it, that is smaller is closed
    texel_m: float = 0.015  # of the picture of the planes

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self._flatness
        if self.snap_m <= 0.0 or self.outline_m < 0.0 or self.hole_m2 < 0.0 or self.texel_m < 0.001:
            raise ValueError("snap_m, outline_m, hole_m2, texel_m: must be positive, not negative twice, and at least a millimetre")

    @property
    def _flatness(self) -> Flatness:
        return Flatness(self.distance_m, self.angle_deg, self.rim_m, self.rim, self.area_m2, self.bend_per_m)

    def _surface(self, state: Gathered, map: Map | None, rest: bool) -> Surface:
        """The planes as polygons; `rest` says whether the triangles that lie in none stay, joined to them."""
        vertices, triangles = self._mesh(state, map)
        opposite = opposite_half_edges(triangles)
        ids, known = map_planes(map)
        labels, planes = planar_labels(vertices, vertex_normals(vertices, triangles), triangles, opposite, known, self._flatness)
        if not rest:
            vertices, triangles = with_single_fans(vertices, triangles[labels >= 0])
            labels = labels[labels >= 0]
            opposite = opposite_half_edges(triangles)
        flat = flattened(vertices, triangles, opposite, labels, planes, self.snap_m, self.outline_m, self.hole_m2)
        shown = flat.labels >= (REST if rest else 0)
        triangles, labels = without_pinholes(flat.vertices, flat.triangles[shown], flat.labels[shown])
        return pictured(state, map, flat.vertices, triangles, labels, planes, numbered(ids, len(planes), map), flat.loops, self.texel_m)
