"""Look at an IFC file from above, with or without a display, by IfcOpenShell's geometry and PyVista.

python3 -m venv viewer
viewer/bin/pip install ifcopenshell pyvista
viewer/bin/python examples/look_at_ifc.py model.ifc             # in a window, where the mouse rotates the model
viewer/bin/python examples/look_at_ifc.py model.ifc model.png   # as a picture, without a display

Each storey has a view of its own, on top of those below it and without its ceiling. Openings are cut out of walls; spaces are names.
Nothing of Trihedron is used: the picture shows what another program reads. The libraries (LGPL-3.0, MIT) take a gigabyte.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

COLORS = {"IfcWall": "#dfe3e8", "IfcSlab": "#d0b48c"}  # other elements: OTHER
OTHER = "#7aa6c2"
EYE, UP = (-0.5, -0.8, 1.8), (0.0, 0.0, 1.0)  # direction from the model to the eye


def triangulate(model: Any, products: list[Any]) -> dict[int, Any]:
    """Return the mesh of each product with a shape by its id: metres, world coordinates, openings subtracted."""
    import ifcopenshell.geom
    import numpy as np
    import pyvista

    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    meshes = {}
    for shape in ifcopenshell.geom.iterator(settings, model, include=products) if products else ():
        vertices, triangles = np.reshape(shape.geometry.verts, (-1, 3)), np.reshape(shape.geometry.faces, (-1, 3))
        meshes[shape.id] = pyvista.PolyData.from_regular_faces(vertices, triangles)
    return meshes


def draw(plotter: Any, storeys: list[Any], meshes: dict[int, Any]) -> None:
    """Draw storeys from the lowest on, the last without its ceiling and with the names of its spaces."""
    from ifcopenshell.util.element import get_decomposition

    elements = [(storey, element) for storey in storeys for element in get_decomposition(storey) if element.id() in meshes]
    for storey, element in elements:
        mesh, last = meshes[element.id()], storey is storeys[-1]
        if element.is_a("IfcSpace"):
            if last:
                name, (x, y, _) = element.LongName or element.Name or "space", mesh.center
                place = [(x, y, mesh.bounds.z_max)]  # at the top of its walls, which would hide one on the floor
                plotter.add_point_labels(place, [name], font_size=18, show_points=False, shape_color="white", always_visible=True)
        elif not (last and element.is_a("IfcSlab") and element.PredefinedType == "ROOF"):
            color = next((color for kind, color in COLORS.items() if element.is_a(kind)), OTHER)
            plotter.add_mesh(mesh, color=color, ambient=0.3)
            plotter.add_mesh(mesh.extract_feature_edges(20), color="#404040", line_width=1.5)
    plotter.add_text(storeys[-1].Name or "storey", font_size=10)
    plotter.camera_position = [EYE, (0.0, 0.0, 0.0), UP]
    plotter.reset_camera()


def look(path: Path, picture: Path | None = None) -> None:
    """Show the storeys of a file in a window, or write them as a picture."""
    import ifcopenshell
    import pyvista

    try:
        model = ifcopenshell.open(str(path))
    except (OSError, ifcopenshell.Error) as error:
        sys.exit(f"look_at_ifc: {path}: cannot be read ({str(error).rstrip('.')}); give an IFC file")
    products = [one for one in model.by_type("IfcProduct") if one.Representation and not one.is_a("IfcFeatureElement")]
    meshes = triangulate(model, products)
    storeys = sorted(model.by_type("IfcBuildingStorey"), key=lambda storey: storey.Elevation or 0.0)
    if not storeys:
        sys.exit(f"look_at_ifc: {path}: has no IfcBuildingStorey; give a model of a building")
    size = (800 * len(storeys), 640)
    plotter = pyvista.Plotter(off_screen=picture is not None, shape=(1, len(storeys)), window_size=size, border=False)
    for k in range(len(storeys)):
        plotter.subplot(0, k)
        draw(plotter, storeys[: k + 1], meshes)
    if picture is None:
        plotter.show()
    else:
        plotter.screenshot(picture)
    counts = (f"{kind} {sum(one.is_a(kind) for one in products)}" for kind in ("IfcWall", "IfcSlab", "IfcSpace"))
    print(f"{path}: storeys {len(storeys)}, {', '.join(counts)}, IfcOpeningElement {len(model.by_type('IfcOpeningElement'))}")


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 3:
        sys.exit("look_at_ifc: give an IFC file, and a picture to write: python examples/look_at_ifc.py model.ifc model.png")
    try:
        look(*map(Path, sys.argv[1:]))
    except ImportError as error:
        sys.exit(f"look_at_ifc: {error.name}: is not installed; install it with: pip install ifcopenshell pyvista")
