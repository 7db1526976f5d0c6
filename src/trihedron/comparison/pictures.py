"""Pictures of a frame with what a run found in it, of one run or of two side by side."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.files import new_file

if TYPE_CHECKING:
    from trihedron.pipeline.core.types import F64, Camera, Map
    from trihedron.pipeline.record.reader import Recording

SIZE_INCHES, DPI = (16, 6.4), 120  # 1920 × 768 px
FRAMED = (0.5, 99.5)  # percentiles of the landmarks between two edges of the map, which holds 98 % of them
MARGIN_M = 0.2
FEATURES = {"planes": "planes", "segments": "3D lines", "keypoints": "key points", "manhattan": "Manhattan axes"}  # topic -> what is drawn of it
PAD_INCHES = 0.15  # round axes, whose labels an equal aspect moves
PAIR_COLORS = ("#0072b2", "#d55e00")  # of two runs; distinguishable for the colour-blind (Okabe and Ito)


def draw(path: str, frame: int, out: Path) -> None:
    """Image with features left, map from above right; the title names what the recording holds of the former. Raises RecordingError when it lacks
    poses or the frame."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    from trihedron.pipeline.app.recorded_values import open_recording
    from trihedron.pipeline.core.errors import RecordingError

    recording = open_recording(Path(path))
    poses = list(recording.values("pose"))
    if not poses:
        raise RecordingError(path, "holds no poses", "record a run with 'outputs=[trajectory]'")
    numbers = [pose.index for pose in poses]
    frame = numbers[len(numbers) // 2] if frame < 0 else frame
    if frame not in numbers:
        raise RecordingError(path, f"has no frame {frame}", f"give one of {numbers[0]}..{numbers[-1]}")
    figure = Figure(figsize=SIZE_INCHES, layout=ConstrainedLayoutEngine(h_pad=PAD_INCHES))
    left, right = figure.subplots(1, 2, width_ratios=[4, 3])
    left.imshow(_annotate_frame([recording], frame))
    left.set_axis_off()
    left.set_title(f"frame {frame}: {_contents(recording)}", fontsize=10)
    _map_from_above(right, recording, poses)
    with new_file(out) as new:
        figure.savefig(new, dpi=DPI)


def draw_pair(sides: Sequence[tuple[str, Sequence[Recording]]], frame: int, out: Path) -> None:
    """Draw one frame of two runs beside each other, with both paths from above. A side is a title and the recordings in which its topics are looked
    up, the first that has one; the last holds the images."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(15, 4.2), layout=ConstrainedLayoutEngine(h_pad=PAD_INCHES))
    axes = figure.subplots(1, 3)
    for side, (title, recordings) in zip(axes, sides):
        side.imshow(_annotate_frame(recordings, frame))
        side.set_axis_off()
        side.set_title(f"frame {frame}: {title}{_lacking(recordings, frame)}", fontsize=10)
    for (title, recordings), color, style in zip(sides, PAIR_COLORS, ("-", "--")):
        _path_from_above(axes[2], _values(recordings, "pose"), frame, title, color, style)
    axes[2].set_aspect("equal", adjustable="datalim")
    axes[2].set_xlabel("x [m]")
    axes[2].set_ylabel("z [m]")
    axes[2].legend(loc="best", fontsize=8)
    with new_file(out) as new:
        figure.savefig(new, dpi=80)


def _lacking(recordings: Sequence[Recording], frame: int) -> str:
    """Say that a run found no Manhattan frame in a frame, whose picture then has no axes."""
    reference = recordings[-1].reference(frame)
    found = _value(recordings, "manhattan", reference.stamp_ns) if reference is not None else None
    return ", no Manhattan frame" if found is not None and not found.supported else ""


def _path_from_above(axes: Any, poses: Iterable[Any], frame: int, title: str, color: str, style: str) -> None:
    """The path, with a mark at a frame."""
    import numpy as np

    tracked = [pose for pose in poses if pose.status != "lost"]
    path = np.array([pose.T_world_camera[:3, 3] for pose in tracked]).reshape(-1, 3)
    axes.plot(path[:, 0], path[:, 2], style, color=color, linewidth=1.5, label=title)
    here = path[[pose.index == frame for pose in tracked]]
    axes.plot(here[:, 0], here[:, 2], "o", color=color, markersize=7, markerfacecolor="none")


def _values(recordings: Sequence[Recording], topic: str) -> Iterator[Any]:
    """The values of a topic in the first recording that has it."""
    return next((recording.values(topic) for recording in recordings if topic in recording.topics), iter(()))


def _value(recordings: Sequence[Recording], topic: str, stamp_ns: int) -> Any:
    """The value of a topic with this stamp in the first recording that has the topic, or None."""
    return next((recording.value(topic, stamp_ns) for recording in recordings if topic in recording.topics), None)


def _annotate_frame(recordings: Sequence[Recording], frame: int) -> Any:
    """The frame's image (the nearest one that was kept to look at) with the features of that very frame."""
    import numpy as np

    from trihedron.pipeline.core.pictures import draw_axes, draw_keypoints, draw_lines, tint_planes

    reference = recordings[-1].reference(frame)
    assert reference is not None, "the frame is one of the recording's"
    camera = reference.camera
    image = _image(recordings[-1], reference.stamp_ns, camera)
    values: dict[str, Any] = {topic: _value(recordings, topic, reference.stamp_ns) for topic in FEATURES}
    if values["planes"] is not None:
        image = tint_planes(image, values["planes"])
    if values["segments"] is not None:
        draw_lines(image, values["segments"].endpoints_px, np.isfinite(values["segments"].endpoints_m).all(axis=(1, 2)))
    if values["keypoints"] is not None:
        draw_keypoints(image, values["keypoints"].pixels)
    if values["manhattan"] is not None and values["manhattan"].supported:
        draw_axes(image, values["manhattan"].rotations[0])
    return image


def _contents(recording: Recording) -> str:
    """Say which features a recording has, and if it has no images, as that of a run over recorded features."""
    features = ", ".join(name for topic, name in FEATURES.items() if topic in recording.topics) or "no features"
    seen = "dataset" in recording.topics or "/view/image" in recording.channels
    return features if seen else f"{features}; the recording holds no images"


def _image(recording: Recording, stamp_ns: int, camera: Camera) -> Any:
    """The embedded frame, else the small image nearest in time, at full size (RGB)."""
    import cv2
    import numpy as np
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    from trihedron.datasets.readers.picture_headers import UnreadableImage
    from trihedron.datasets.readers.pixels import color_of
    from trihedron.datasets.readers.robot_values import Picture
    from trihedron.pipeline.core.errors import RecordingError

    whole: Any = recording.value("dataset", stamp_ns) if "dataset" in recording.topics else None
    if whole is not None:
        return np.array(whole.color)
    messages = list(recording.messages("/view/image"))
    if not messages:
        return np.full((camera.height, camera.width, 3), 255, np.uint8)
    nearest = min(messages, key=lambda message: abs(message[0] - stamp_ns))
    data = CompressedImage.FromString(nearest[1]).data
    try:
        small = color_of(Picture(nearest[0], "", "jpeg", data, compressed=True))
    except UnreadableImage as error:
        raise RecordingError(str(recording.path), f"topic /view/image: an image {error}", "the file is damaged; record it again") from error
    return cv2.resize(small, (camera.width, camera.height))


def _map_from_above(axes: Any, recording: Recording, poses: list[Any]) -> None:
    """Landmarks and the path, seen along the scene's vertical as far as the first camera knows it (y down)."""
    import numpy as np

    from trihedron.pipeline.app.recorded_values import last_map

    final = last_map(recording)
    path = np.array([pose.T_world_camera[:3, 3] for pose in poses])
    shown = [path[:, [0, 2]]]
    if final is not None:
        found = _draw_landmarks(axes, final)
        if len(found):
            shown.append(np.percentile(found[:, [0, 2]], FRAMED, axis=0))
    low, high = np.concatenate(shown).min(axis=0) - MARGIN_M, np.concatenate(shown).max(axis=0) + MARGIN_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.plot(path[:, 0], path[:, 2], color="crimson", linewidth=2, label="camera")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("z [m]")
    axes.set_title("map from above: points, lines, planes", fontsize=10)
    axes.legend(loc="upper right", fontsize=8)


def _draw_landmarks(axes: Any, map: Map) -> F64:
    """Draw what is alive in the map; returns the points (n, 3) that it was drawn from."""
    import numpy as np

    points = map.points.column("position_m")[map.points.column("alive")]
    axes.scatter(points[:, 0], points[:, 2], s=1, color="0.6")
    lines = map.lines.column("endpoints_m")[map.lines.column("alive")]
    for ends in lines:
        axes.plot(ends[:, 0], ends[:, 2], color="tab:blue", linewidth=0.8)
    planes = [samples[np.isfinite(samples[:, 0])] for samples in map.planes.column("samples_m")[map.planes.column("alive")]]
    for k, samples in enumerate(planes):
        axes.scatter(samples[:, 0], samples[:, 2], s=10, marker="s", color=f"C{k % 10}")
    return np.concatenate([points, lines.reshape(-1, 3), *planes])
