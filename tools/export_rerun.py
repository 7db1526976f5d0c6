"""A run for rerun: frames, features, planes, axes, the map, the surface, and the estimate against the truth, on the timelines `frame` and `stamp`.

Needs rerun-sdk. Images are the embedded frames, else the small ones that every recording holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from trihedron.pipeline.app.recorded_values import references_of
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import new_file
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.record.foxglove import TopicView
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.rerun_view import IMAGE, at, begin, blueprint, require_rerun, show_pinhole, show_value
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.tools.export import Format

TOPICS = ("keypoints", "segments", "planes", "manhattan", "pose", "map", "surface", "building")  # what is shown
MAP_EVERY = 10  # versions of the map; each is logged whole


def write_rerun(recording: Recording, path: Path) -> str:
    """RRD: what `trihedron view` shows."""
    rerun = require_rerun()
    stream = rerun.RecordingStream("trihedron")
    with new_file(path) as new:
        stream.save(new, default_blueprint=blueprint())
        count = show(recording, stream)
        stream.flush()
    return f"{count} frames; open it with: rerun {path}"


def show(recording: Recording, stream: Any, after: int = -1) -> int:
    """Log the frames of a run after the number `after` to a rerun stream; returns the number of all its frames. Raises DataError for a recording
    without frames."""
    references = references_of(recording)
    if not references:
        raise DataError(str(recording.path), "holds no frames", "record a run")
    load_plugins()  # they draw their values
    if after < 0:
        begin(stream)
    _show_images(recording, stream, after)
    for topic in TOPICS:
        for number, value in enumerate(recording.values(topic) if topic in recording.topics else ()):
            if value.index > after and (topic != "map" or number % MAP_EVERY == 0 or number + 1 == recording.counts["/map"]):
                at(stream, value.index, value.stamp_ns)
                show_value(stream, value)
    _show_truth(recording, stream, after)
    return len(references)


def _show_images(recording: Recording, stream: Any, after: int) -> None:
    """The images, and the camera that belongs to their size."""
    import rerun

    by_stamp = {reference.stamp_ns: reference for reference in references_of(recording).values()}
    if "dataset" in recording.topics:
        for value in recording.values("dataset"):
            if value.index > after:
                at(stream, value.index, value.stamp_ns)
                show_value(stream, value)
        return
    for stamp_ns, data in recording.messages("/view/image"):
        reference = by_stamp[stamp_ns]
        if reference.index <= after:
            continue
        at(stream, reference.index, stamp_ns)
        show_pinhole(stream, reference.camera, 0.5)
        stream.log(IMAGE, rerun.EncodedImage(contents=CompressedImage.FromString(data).data, media_type="image/jpeg"))


def _show_truth(recording: Recording, stream: Any, after: int) -> None:
    """The true path in the world of the run, and the error of each pose, as Foxglove's `/error`."""
    import rerun

    view = TopicView(attached_truth(recording.attachments, str(recording.path)))
    true = []
    for value in recording.values("pose") if "pose" in recording.topics else ():
        found = dict(view.messages(value))
        if "/error" in found:
            if value.index > after:
                at(stream, value.index, value.stamp_ns)
                stream.log("error/position_m", rerun.Scalars(found["/error"].translation_m))
                stream.log("error/rotation_deg", rerun.Scalars(found["/error"].rotation_deg))
            place = found["/view/truth"].pose.position
            true.append((place.x, place.y, place.z))
    if true:
        stream.log("world/truth", rerun.LineStrips3D([true], colors=(40, 170, 40)), static=True)


FORMATS = (Format("rerun", "run.rrd", write_rerun),)
