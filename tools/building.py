"""Make the plan of a building from a recording: building.json, floorplan.svg, floorplan.dxf, building.glb and model.ifc.

RUN is a run folder or its recording. A building that is recorded (outputs=[trajectory,building]) is written as it is; else, or with --plugin, it is
made from the frames, planes and poses of the recording. Metres; z up from the lowest floor, y (north on the plan) the direction of the building
nearest to the first camera's view. model.ifc needs ifcopenshell: pip install 'trihedron[ifc]'. --pdf adds floorplan.pdf, at 1:50, 1:100 or 1:200
on A4 or A3; one that is there is made again.

Corrections are made in building.json: "deleted": true, another kind, a name, a use, an opening without an id. --edits building.json keeps them.

Example: trihedron building runs/latest
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.recorded_building import building_of
from trihedron.tools.arguments import Parser

if TYPE_CHECKING:
    from trihedron.pipeline.core.types import Building


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises DataError for a recording without poses, planes or frames, UsageError for wrong arguments."""
    parser = Parser("building", __name__)
    parser.add_argument("run", metavar="RUN", type=Path)
    parser.add_argument("--plugin", metavar="NAME", help="make it anew by this plugin, for example atlanta_layout (default: as recorded)")
    parser.add_argument("--edits", metavar="FILE", help="a building.json that was corrected by hand; what was changed there is kept")
    parser.add_argument("--out", metavar="FOLDER", type=Path, help="where to write (default: beside the recording)")
    parser.add_argument("--pdf", action="store_true", help="write floorplan.pdf too, to scale")
    options = parser.parse(argv)
    from trihedron.pipeline.core.libraries import library_error
    from trihedron.pipeline.core.registry import load_plugins, plugins_of
    from trihedron.pipeline.record.mcap_file import RECORDING, recording_file
    from trihedron.pipeline.record.reader import Recording
    from trihedron.plugins.building.dxf import DXF, has_dxf
    from trihedron.plugins.building.files import GLB, JSON, write_building
    from trihedron.plugins.building.ifc import IFC, has_ifc, write_ifc
    from trihedron.plugins.building.pdf import PDF, write_pdf
    from trihedron.plugins.building.svg import SVG

    load_plugins()
    if options.plugin is not None and options.plugin not in plugins_of("building"):
        raise UsageError("building", f"there is no building '{options.plugin}'", did_you_mean(options.plugin, list(plugins_of("building"))))
    path = recording_file(options.run)
    out: Path = options.out or path.parent
    building = building_of(Recording(path), options.plugin, options.edits or "")
    if options.edits is None and _has_more_edits(out / JSON, building):
        raise UsageError(str(out / JSON), "holds corrections by hand, which would be lost", f"give --edits {out / JSON}, or another --out FOLDER")
    try:
        out.mkdir(parents=True, exist_ok=True)
        name = path.resolve().parent.name if path.name == RECORDING else path.stem
        for line in write_building(out, building, name):
            print(line)
        has_pdf = options.pdf or (out / PDF).exists()  # an older one would be of another plan than the files beside it
        if has_pdf:
            write_pdf(out / PDF, building, name)
        if has_ifc():
            write_ifc(out / IFC, building)
    except OSError as error:
        raise DataError(str(error.filename or out), f"cannot be written: {error.strerror}", "give another --out FOLDER") from error
    for file in (JSON, SVG, *((PDF,) if has_pdf else ()), *((DXF,) if has_dxf() else ()), GLB, *((IFC,) if has_ifc() else ())):
        print(f"  {out / file}")
    if not has_ifc():
        print(f"no {IFC}: {library_error('ifcopenshell')}")
    return 0


def _has_more_edits(path: Path, building: Building) -> bool:
    """Say if a file has corrections by hand that the building lacks. Raises DataError for a file with a mistake."""
    from trihedron.plugins.building.edits import edits_in
    from trihedron.plugins.building.files import building_json, kept_edits

    return bool(set(kept_edits(path)) - set(edits_in(str(path), building_json(building))))
