"""The building of a recorded run: as recorded, or folded from its frames, planes and poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.errors import DataError

if TYPE_CHECKING:
    from trihedron.pipeline.core.types import Building, Map
    from trihedron.pipeline.record.reader import Recording


def building_of(recording: Recording, plugin: str | None = None, edits: str = "") -> Building:
    """Return the recorded building, or the one that a plugin (default: manhattan_layout) makes of the recording, with the corrections in a file
    `edits`. Raises DataError."""
    from trihedron.pipeline.core.types import Building
    from trihedron.plugins.building.edits import apply_edits, read_edits

    corrections = read_edits(edits)

    if plugin is None and "building" in recording.topics:
        for value in recording.values("building"):
            if isinstance(value, Building):
                return apply_edits(value, corrections)
    return apply_edits(building_by(recording, plugin or "manhattan_layout"), corrections)


def building_by(recording: Recording, name: str) -> Building:
    """Fold the recording's frames by a plugin with its default options. Raises DataError when planes are not recorded, or the frames are gone."""
    fold, state, final = fold_recording(recording, name)
    building: Building = fold.finish(state, final)
    return building


def fold_recording(recording: Recording, name: str) -> tuple[Any, Any, Map | None]:
    """Return a plugin with its default options, its state after all frames of a recording, and the last map. Raises DataError."""
    from trihedron.pipeline.app.recorded_values import frames_of, last_map, poses_of, references_of
    from trihedron.pipeline.core.registry import plugin_class
    from trihedron.pipeline.core.types import Pose
    from trihedron.pipeline.core.value_checks import check_together

    if "planes" not in recording.topics:
        raise DataError(str(recording.path), "holds no planes", "record a run of a graph with planes")
    frame_of, references, final = frames_of(recording), references_of(recording), last_map(recording)
    poses: dict[int, Pose] = {pose.index: pose for pose in poses_of(recording)}
    maps = recording.values("map") if "map" in recording.topics else iter(())
    newest = next(maps, None)  # one at a time: those of a long recording do not fit into memory together
    fold = plugin_class("building", name)()
    state = fold.start()
    rotations = {v.index: v for v in recording.values("rotation")} if "rotation" in recording.topics else {}
    every = newest is None
    given = ("frame", "planes", "rotation", "pose", "map")
    for planes in recording.values("planes"):
        index = planes.index
        while newest is not None and newest.index < index:
            newest = next(maps, None)
        current = newest if newest is not None and newest.index == index else None
        if not (every or current is not None) or index not in poses or index not in references:
            continue
        frame = frame_of(references[index])
        if frame is not None:
            values = dict(zip(given, (frame, planes, rotations.get(index), poses[index], current)))
            check_together(values, str(recording.path), {topic: topic for topic in given})
            state = fold.add(state, **values) if name != "none" else fold.add(state, pose=values["pose"])
    return fold, state, final
