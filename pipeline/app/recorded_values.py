"""Read from a recording what belongs to the run as a whole: the frames themselves, the last map, the final trajectory."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from trihedron.pipeline.app.recorded_run import composed_run
from trihedron.pipeline.core.config import make_plugin
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.options import frame_range
from trihedron.pipeline.core.types import Frame, FrameReference, Map, Pose, Trajectory, Value
from trihedron.pipeline.record.mcap_file import in_use, recording_file
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.rescue import recover
from trihedron.pipeline.run.accounting import Result
from trihedron.pipeline.run.poses import Poses
from trihedron.pipeline.run.replay import at_rate
from trihedron.pipeline.run.results import final_trajectory


def open_recording(path: Path, announce: bool = True) -> Recording:
    """Open a recording, by its file or the folder of its run; of one that is still being written, a copy of what the file holds so far, which a line
    on stderr reports. Raises RecordingError."""
    path = recording_file(path)
    if not in_use(path):
        return Recording(path)
    with TemporaryDirectory(prefix="trihedron-") as folder:
        copy = Path(folder) / path.name
        count = recover(path, copy, being_written=True).messages
        found = Recording(copy)  # which stays open
    found.path = path
    if announce:
        print(f"trihedron: {path} is still being written; its first {count} messages are read", file=sys.stderr)
    return found


def poses_of(recording: Recording) -> list[Pose]:
    """The poses as they were estimated at the time. Raises DataError when there are none."""
    poses = [value for value in _values(recording, "pose") if isinstance(value, Pose)]
    if not poses:
        raise DataError(str(recording.path), "holds no poses", "record a run with 'outputs=[trajectory]'")
    return poses


def last_map(recording: Recording) -> Map | None:
    """The map at the end, or None."""
    found = None
    for value in recording.values("map") if "map" in recording.topics else ():
        found = value if isinstance(value, Map) else found
    return found


def trajectory_of(recording: Recording) -> Trajectory:
    """The final poses of all tracked frames, as trajectory.txt has them."""
    return final_trajectory(Result(poses=Poses(poses_of(recording)), map=last_map(recording)))


def references_of(recording: Recording) -> dict[int, FrameReference]:
    """Frame number -> camera and stamp."""
    return {value.index: value for value in recording.references}


def _values(recording: Recording, topic: str) -> Iterator[Value]:
    """The values of a topic; none of a topic that is not recorded. Raises RecordingError."""
    yield from recording.values(topic) if topic in recording.topics else ()


def frames_of(recording: Recording) -> Callable[[FrameReference], Frame | None]:
    """Access to a frame's images: those embedded, else those of the data set that was tracked. DataError when that is gone."""
    if "dataset" in recording.topics:

        def embedded_frame(reference: FrameReference) -> Frame | None:
            value = recording.value("dataset", reference.stamp_ns)
            return value if isinstance(value, Frame) else None

        return embedded_frame
    options = composed_run(recording).dataset
    dataset, numbers = make_plugin("dataset", options), frame_range(str(options.get("frames", "")))
    try:
        len(dataset)
    except DataError as error:
        cause = f"does not embed its frames, and the data set is gone ({error.place}: {error.cause})"
        raise DataError(str(recording.path), cause, "record with record.frames=true") from error

    def dataset_frame(reference: FrameReference) -> Frame | None:
        frame: Frame | None = dataset(numbers.index(reference.index))
        return frame if frame is None else at_rate(frame, reference.camera.fps)

    return dataset_frame
