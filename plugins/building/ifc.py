"""The building as IFC4, by ifcopenshell: project, site, building, storeys, walls with thickness, slabs, openings and spaces; metres.

Slabs and the thickness of walls whose other face was not seen are nominal, and a property of each states it. An opening is a void in its wall:
whether a leaf or a pane hangs in it was not measured. Nor was whether a wall is external (there is no Pset_WallCommon), nor what walls and slabs are
of: their material is named unknown."""

from __future__ import annotations

import importlib.util
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.files import new_file
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.linalg import norm
from trihedron.pipeline.core.plan_areas import area_interval, area_sigma, seen_share
from trihedron.pipeline.core.types import ELEMENTS, F64, SUPPORTS, Building
from trihedron.plugins.building.geometry import SHEET_M, floor_plate, joined_spans, rings_of, rings_of_parts, rooms_on, storey_levels
from trihedron.plugins.building.labels import label_of, use_of

IFC = "model.ifc"
SLAB_M = 0.2  # thickness of a slab, but between two storeys, where it was measured
SLIVER_M = 0.2  # width below which what one storey leaves uncovered of another is an error of their walls
MARGIN_M = 0.01  # by which a void is thicker than its wall
PROPERTIES = "Trihedron_Measurement"
NAMESPACE = uuid.UUID("8d1c0a3e-6f2b-5f7e-9a4d-2b1f6c7e9d10")  # of the GlobalIds: the same building gives the same


def has_ifc() -> bool:
    """Say if ifcopenshell is installed."""
    return importlib.util.find_spec("ifcopenshell") is not None


def write_ifc(path: Path, building: Building) -> None:
    """Write the file. Raises LibraryError where ifcopenshell is not installed."""
    with imports_of("ifcopenshell"):
        import ifcopenshell  # noqa: F401
    _IfcWriter(building).write(path)


class _IfcWriter:
    """A file that is being made."""

    def __init__(self, building: Building) -> None:
        import ifcopenshell.api.aggregate
        import ifcopenshell.api.context
        import ifcopenshell.api.feature
        import ifcopenshell.api.geometry
        import ifcopenshell.api.material
        import ifcopenshell.api.project
        import ifcopenshell.api.pset
        import ifcopenshell.api.root
        import ifcopenshell.api.spatial
        import ifcopenshell.api.unit
        from ifcopenshell.util.shape_builder import ShapeBuilder

        self.building, self.api = building, ifcopenshell.api
        self.file = self.api.project.create_file(version="IFC4")
        self.shapes = ShapeBuilder(self.file)
        self.project = self._entity("IfcProject", "trihedron")
        self.api.unit.assign_unit(self.file, length={"is_metric": True, "raw": "METERS"}, area={"is_metric": True, "raw": "METERS"})
        model = self.api.context.add_context(self.file, context_type="Model")
        view = {"context_identifier": "Body", "target_view": "MODEL_VIEW", "parent": model}
        self.body = self.api.context.add_context(self.file, context_type="Model", **view)
        plan = self.api.context.add_context(self.file, context_type="Plan")
        view = {"context_identifier": "Axis", "target_view": "GRAPH_VIEW", "parent": plan}
        self.axis = self.api.context.add_context(self.file, context_type="Plan", **view)

    def write(self, path: Path) -> None:
        """Make all elements and write them."""
        site, house = self._entity("IfcSite", "site"), self._entity("IfcBuilding", "building")
        house.Description = self.building.note or None
        self._aggregate(site, self.project)
        self._aggregate(house, site)
        storeys = [self._storey(k, house) for k in range(len(self.building.storeys))]
        spans = {wall: span for k in range(len(storeys)) for wall, span in joined_spans(self.building, k).items()}
        walls = [self._wall(k, storeys[self.building.wall_storeys[k]], spans[k]) for k in range(len(self.building.walls_m))]
        for k, wall in enumerate(self.building.opening_walls):
            self._opening(k, walls[wall])
        self._material([*walls, *self.file.by_type("IfcSlab")])
        for number, root in enumerate(self.file.by_type("IfcRoot")):
            root.GlobalId = self._guid(number)
        with new_file(path) as new:
            self.file.write(str(new))

    def _guid(self, number: int) -> str:
        import ifcopenshell.guid

        return str(ifcopenshell.guid.compress(uuid.uuid5(NAMESPACE, f"{self.building.stamp_ns} {self.building.index} {number}").hex))

    def _entity(self, kind: str, name: str) -> Any:
        return self.api.root.create_entity(self.file, ifc_class=kind, name=name)

    def _aggregate(self, part: Any, whole: Any) -> None:
        self.api.aggregate.assign_object(self.file, products=[part], relating_object=whole)

    def _place(self, element: Any, origin: F64, x: F64) -> None:
        """Place an element at `origin` (3,) with its x axis along `x` (2,) and z up."""
        T = np.eye(4)
        T[:2, 0], T[:2, 1], T[:3, 3] = x, [-x[1], x[0]], origin
        self.api.geometry.edit_object_placement(self.file, product=element, matrix=T)

    def _solid(self, element: Any, rings: list[F64], height: float) -> None:
        """Give an element the prism over a polygon in its own frame."""
        outer, *inner = (self.shapes.polyline([tuple(map(float, point)) for point in ring], closed=True) for ring in rings)
        profile = self.shapes.profile(outer, inner_curves=inner)
        shape = self.shapes.get_representation(self.body, [self.shapes.extrude(profile, magnitude=float(height))])
        self.api.geometry.assign_representation(self.file, product=element, representation=shape)

    def _axis(self, wall: Any, length: float, depth: float) -> None:
        """Give a wall its centre line, in its own frame."""
        curve = self.shapes.polyline([(0.0, -depth / 2.0), (length, -depth / 2.0)])
        self.api.geometry.assign_representation(self.file, product=wall, representation=self.shapes.get_representation(self.axis, [curve]))

    def _material(self, products: list[Any]) -> None:
        """Say of elements that what they are of is not known."""
        if products:
            unknown = self.api.material.add_material(self.file, name="unknown")
            self.api.material.assign_material(self.file, products=products, type="IfcMaterial", material=unknown)

    def _evidence(self, kind: str, number: int) -> dict[str, int]:
        """Return how many keyframes and frames an element rests on."""
        rows = self.building.support[(self.building.support[:, 0] == ELEMENTS.index(kind)) & (self.building.support[:, 1] == number)]
        return {f"{name.capitalize()}s": int((rows[:, 2] == SUPPORTS.index(name)).sum()) for name in ("keyframe", "frame")}

    def _properties(self, element: Any, **values: Any) -> None:
        known = {name: value for name, value in values.items() if not isinstance(value, float) or np.isfinite(value)}
        self.api.pset.edit_pset(self.file, pset=self.api.pset.add_pset(self.file, product=element, name=PROPERTIES), properties=known)

    def _storey(self, k: int, house: Any) -> Any:
        low, high = storey_levels(self.building, k)
        storey = self._entity("IfcBuildingStorey", f"storey {k}")
        storey.Elevation = low
        self._aggregate(storey, house)
        self._place(storey, np.array([0.0, 0.0, low]), np.array([1.0, 0.0]))
        seen = np.isfinite(self.building.storeys[k])
        floor_sigma, ceiling_sigma = (float(value) for value in np.sqrt(np.diag(self.building.storey_covariance[k])))
        self._properties(
            storey, FloorMeasured=bool(seen[0]), CeilingMeasured=bool(seen[1]), FloorSigma=floor_sigma, CeilingSigma=ceiling_sigma,
            **self._evidence("storey", k),
        )  # fmt: skip
        for room in rooms_on(self.building, k):
            self._space(room, storey, low, high)
        plate = floor_plate(self.building, k)
        for rings in rings_of_parts(plate) if seen[0] else ():
            self._slab(rings, storey, k, "FLOOR", low)
        for rings in rings_of_parts(self._roof(plate, k)) if seen[1] else ():
            self._slab(rings, storey, k, "ROOF", high)
        return storey

    def _roof(self, plate: Any, k: int) -> Any:
        """Return the area of a storey's plate that the floor of the storey above it leaves open, without slivers."""
        if k + 1 == len(self.building.storeys) or not np.isfinite(self.building.storeys[k + 1, 0]):
            return plate
        open_area = plate.difference(floor_plate(self.building, k + 1))
        return open_area.buffer(-SLIVER_M / 2.0, join_style="mitre").buffer(SLIVER_M / 2.0, join_style="mitre")

    def _space(self, room: int, storey: Any, low: float, high: float) -> None:
        space = self._entity("IfcSpace", f"room {room}")
        space.PredefinedType, space.LongName = "INTERNAL", label_of(self.building, "room", room)
        space.ObjectType = use_of(self.building, room) or None
        self._aggregate(space, storey)
        self._place(space, np.array([0.0, 0.0, low]), np.array([1.0, 0.0]))
        self._solid(space, rings_of(self.building, room), high - low)
        area, sigma = float(self.building.areas_m2[room]), area_sigma(self.building, room)
        quantities = self.api.pset.add_qto(self.file, product=space, name="Qto_SpaceBaseQuantities")
        self.api.pset.edit_qto(self.file, qto=quantities, properties={"NetFloorArea": area, "Height": high - low})
        low_m2, high_m2 = area_interval(self.building, room)
        self._properties(
            space,
            AreaSigma=sigma,
            AreaLow=low_m2,
            AreaHigh=high_m2,
            SeenShare=seen_share(self.building, room),
            SeenAllRound=bool(self.building.closed[room]),
            **self._evidence("room", room),
        )

    def _slab(self, rings: list[F64], storey: Any, k: int, kind: str, height: float) -> None:
        """Make a slab below a storey's floor, or above its ceiling."""
        below = float(self.building.storeys[k - 1, 1]) if k else float("nan")
        measured = kind == "FLOOR" and np.isfinite(below) and below < height
        thickness = height - below if measured else SLAB_M
        slab = self._entity("IfcSlab", f"{kind.lower()} of storey {k}")
        slab.PredefinedType = kind
        self.api.spatial.assign_container(self.file, products=[slab], relating_structure=storey)
        self._place(slab, np.array([0.0, 0.0, height - thickness if kind == "FLOOR" else height]), np.array([1.0, 0.0]))
        self._solid(slab, rings, thickness)
        self._properties(slab, ThicknessMeasured=bool(measured))

    def _wall(self, k: int, storey: Any, span: tuple[float, float]) -> Any:
        """Make a wall from begin to end along it, which corners may lengthen; its axis has the measured length."""
        (start, end), thickness = self.building.walls_m[k], float(self.building.thickness_m[k])
        low, high = storey_levels(self.building, int(self.building.wall_storeys[k]))
        measured, length = bool(np.isfinite(thickness)), float(norm(end - start))
        depth = thickness if measured else SHEET_M
        wall = self._entity("IfcWall", label_of(self.building, "wall", k))
        self.api.spatial.assign_container(self.file, products=[wall], relating_structure=storey)
        self._place(wall, np.array([*start, low]), (end - start) / max(length, 1e-9))
        self._axis(wall, length, depth)
        begin, stop = span
        self._solid(wall, [np.array([[begin, -depth], [stop, -depth], [stop, 0.0], [begin, 0.0]])], high - low)
        offset, deep, turned = (float(value) for value in np.sqrt(np.diag(self.building.wall_covariance[k])))
        unseen = sum(float(row[2] - row[1]) for row in self.building.unseen if int(row[0]) == k)
        sigmas = {"OffsetSigma": offset, "ThicknessSigma": deep, "DirectionSigma": turned}
        self._properties(wall, ThicknessMeasured=measured, UnseenLength=unseen, **sigmas, **self._evidence("wall", k))
        return wall

    def _opening(self, k: int, wall: Any) -> None:
        number = int(self.building.opening_walls[k])
        (start, end), thickness = self.building.walls_m[number], float(self.building.thickness_m[number])
        depth = (thickness if np.isfinite(thickness) else SHEET_M) + 2.0 * MARGIN_M
        along = (end - start) / max(float(norm(end - start)), 1e-9)
        low, _ = storey_levels(self.building, int(self.building.wall_storeys[number]))
        (left, right), (bottom, top) = self.building.spans_m[k], self.building.opening_heights_m[k]
        opening = self._entity("IfcOpeningElement", label_of(self.building, "opening", k))
        opening.PredefinedType = "OPENING"
        self.api.feature.add_feature(self.file, feature=opening, element=wall)
        corner = start + left * along + MARGIN_M * np.array([-along[1], along[0]])
        self._place(opening, np.array([*corner, low + bottom]), along)
        self._solid(opening, [np.array([[0.0, -depth], [right - left, -depth], [right - left, 0.0], [0.0, 0.0]])], top - bottom)
        sides = np.sqrt(np.diag(self.building.opening_covariance[k]))
        sigmas = {f"{side}Sigma": float(sigma) for side, sigma in zip(("Left", "Right", "Bottom", "Top"), sides)}
        self._properties(opening, **sigmas, **self._evidence("opening", k))
