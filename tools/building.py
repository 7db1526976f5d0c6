"""Make the plan of a building from a recording: building.json, floorplan.svg, floorplan.dxf, building.glb and model.ifc.

RUN is a run folder or its recording. A building that is recorded (outputs=[trajectory,building]) is written as it is; else, or with --plugin, it is
made from the frames, planes and poses of the recording. Metres; z up from the lowest floor, y (north on the plan) the direction of the building
nearest to the first camera's view. model.ifc needs ifcopenshell: pip install 'trihedron[ifc]'.

Example: trihedron building runs/latest
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.tools.arguments import Parser

if TYPE_CHECKING:
    from trihedron.pipeline.core.types import Building, Map
    from trihedron.pipeline.record.reader import Recording

RECORDING = "run.mcap"


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises DataError for a recording without poses, planes or frames, UsageError for wrong arguments."""
    parser = Parser("building", __name__)
    parser.add_argument("run", metavar="RUN", type=Path)
    parser.add_argument("--plugin", metavar="NAME", help="make it anew by this plugin, for example atlanta_layout (default: as recorded)")
    parser.add_argument("--out", metavar="FOLDER", type=Path, help="where to write (default: beside the recording)")
    options = parser.parse_args(argv)
    from trihedron.pipeline.core.libraries import library_error
    from trihedron.pipeline.core.registry import load_plugins, plugins_of
    from trihedron.pipeline.record.reader import Recording
    from trihedron.plugins.building.files import DXF, GLB, JSON, SVG, write_building
    from trihedron.plugins.building.ifc import IFC, has_ifc, write_ifc

    load_plugins()
    if options.plugin is not None and options.plugin not in plugins_of("building"):
        raise UsageError("building", f"there is no building '{options.plugin}'", did_you_mean(options.plugin, list(plugins_of("building"))))
    path: Path = options.run / RECORDING if options.run.is_dir() else options.run
    building = building_of(Recording(path), options.plugin)
    out: Path = options.out or path.parent
    try:
        out.mkdir(parents=True, exist_ok=True)
        for line in write_building(out, building):
            print(line)
        if has_ifc():
            write_ifc(out / IFC, building)
    except OSError as error:
        raise DataError(str(error.filename or out), f"cannot be written: {error.strerror}", "give another --out FOLDER") from error
    for name in (JSON, SVG, DXF, GLB, *((IFC,) if has_ifc() else ())):
        print(f"  {out / name}")
    if not has_ifc():
        print(f"no {IFC}: {library_error('ifcopenshell')}")
    return 0


def building_of(recording: Recording, plugin: str | None = None) -> Building:
    """Return the recorded building, or the one that a plugin (default: manhattan_layout) makes of the recording. Raises DataError."""
    from trihedron.pipeline.core.types import Building

    if plugin is None and "building" in recording.topics:
        for value in recording.values("building"):
            if isinstance(value, Building):
                return value
    return folded(recording, plugin or "manhattan_layout")


def folded(recording: Recording, name: str) -> Building:
    """Fold the recording's frames by a plugin with its default options. Raises DataError when planes are not recorded, or the frames are gone."""
    fold, state, final = gathered(recording, name)
    building: Building = fold.finish(state, final)
    return building


def gathered(recording: Recording, name: str) -> tuple[Any, Any, Map | None]:
    """Return a plugin with its default options, its state after all frames of a recording, and the last map. Raises DataError as `folded` does."""
    from trihedron.pipeline.app.recorded_values import frames_of, last_map, poses_of, references_of
    from trihedron.pipeline.core.registry import plugin_class
    from trihedron.pipeline.core.types import Pose
    from trihedron.pipeline.core.value_checks import check_together

    if "planes" not in recording.topics:
        raise DataError(str(recording.path), "holds no planes", "record a run of a graph with planes")
    frame_of, references, final = frames_of(recording), references_of(recording), last_map(recording)
    poses: dict[int, Pose] = {pose.index: pose for pose in poses_of(recording)}
    others = {topic: {v.index: v for v in recording.values(topic) if topic == "map"} for topic in ("map",) if topic in recording.topics}
    maps = others.get("map", {})
    fold = plugin_class("building", name)()
    state = fold.start()
    rotations = {v.index: v for v in recording.values("rotation")} if "rotation" in recording.topics else {}
    wanted = set(maps) if maps else set(poses)
    given = ("frame", "planes", "rotation", "pose", "map")
    for planes in recording.values("planes"):
        index = planes.index
        if index not in wanted or index not in poses or index not in references:
            continue
        frame = frame_of(references[index])
        if frame is not None:
            values = dict(zip(given, (frame, planes, rotations.get(index), poses[index], maps.get(index))))
            check_together(values, str(recording.path), {topic: topic for topic in given})
            state = fold.add(state, **values) if name != "none" else fold.add(state, pose=values["pose"])
    return fold, state, final
