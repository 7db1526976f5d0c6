"""Frames out of an MCAP file or a bag of ROS: a recording of this program, or one of a robot."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from trihedron.datasets.readers.bag_file import BagFile
from trihedron.datasets.readers.cameras import Calibration, choose_calibration
from trihedron.datasets.readers.images import check_camera
from trihedron.datasets.readers.robot_recording import RobotRecording, Topics
from trihedron.datasets.readers.robot_streams import ROS
from trihedron.datasets.readers.rolling_shutter import Look, SteadyFrames, look_at
from trihedron.datasets.readers.sequence import clip_range, refuse_video
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import one_line_errors
from trihedron.pipeline.core.layouts import BAG, METADATA_FILE
from trihedron.pipeline.core.options import Frames, PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Trajectory
from trihedron.pipeline.record.codec import METADATA
from trihedron.pipeline.record.mcap_file import McapFile
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth

log = logging.getLogger("trihedron")


@register("dataset", "mcap")
@dataclass(frozen=True)
class McapDataset:
    """A recording of this program (`record.frames=true`, or `trihedron convert`), whose frames come bit for bit with the ground truth attached
    to it, or one of a robot: messages of ROS (sensor_msgs Image, CompressedImage, compressedDepth, CameraInfo; tf2_msgs) or Foxglove's schemas.

    Of a robot's recording the topics are chosen by their type; where several fit, one is named. Colour is undistorted, and paired with the depth
    nearest in time, which is registered to colour from both intrinsics and the transforms. A camera file describes images as they come without it.
    Without index, or cut off, a recording is read as far as it is whole. Raises DataError when the file holds no frames, RecordingError when it is
    missing, damaged or not MCAP."""

    path: str = ""  # FILE.mcap, FILE.bag of ROS 1, or the folder of a rosbag2
    frames: Frames = ""  # half-open range of frame numbers: A:B, A:, :B, every S-th A:B:S; empty = all
    color_topic: str = ""  # of a robot's recording; empty = the only one with colour images
    depth_topic: str = ""  # empty = the only one with depth images
    color_info_topic: str = ""  # intrinsics; empty = those beside the images, else of the same coordinate frame
    depth_info_topic: str = ""  # likewise of depth
    truth_from: str = ""  # a topic of poses (/mocap/pose), or the frame the transforms of the camera begin from (map); empty = no truth
    max_difference_ms: PositiveFloat = 20.0  # of the stamps of a pair of colour and depth
    depth_delay_ms: float = 0.0  # by which the stamps of depth are early, for pairing
    depth_scale: PositiveFloat = 1000.0  # of 16-bit depth: values per metre; that of a camera file takes its place
    camera: str = ""  # camera.yaml of the images undistorted and registered by what the recording states; empty = as that states

    @cached_property
    def _frames(self) -> _Recorded | RobotRecording:
        if not self.path:
            raise DataError("dataset.path", "is not set", "give dataset.path=FILE.mcap, FILE.bag or the folder of a rosbag2")
        file = open_messages(Path(self.path).expanduser())
        if isinstance(file, McapFile) and METADATA in file.metadata:
            return _Recorded(Recording(file.path))
        if not file.complete:
            log.warning("%s is cut off; what is whole of it is read", file.path)
        topics = Topics(self.color_topic, self.depth_topic, self.color_info_topic, self.depth_info_topic, self.truth_from)
        depth_scale, known_delay_s = (self.depth_scale, 0.0) if self._given is None else (self._given.depth_scale, self._given.depth_delay_s)
        return RobotRecording(file, topics, round(self.max_difference_ms * 1e6), round(self.depth_delay_ms * 1e6), depth_scale, known_delay_s)

    @cached_property
    def _given(self) -> Calibration | None:
        return choose_calibration(Path(), self.camera) if self.camera else None

    @cached_property
    def _range(self) -> range:
        return clip_range(self.frames, len(self._frames), self.path)

    def __len__(self) -> int:
        with one_line_errors(self.path):
            return len(self._range)

    def __call__(self, index: int) -> Frame | None:
        """Read frame `index` of the selection, or None, after a warning, where it cannot be read."""
        with one_line_errors(self.path):
            frame, given = self._frames.frame(self._range[index]), self._given
            if frame is None or given is None:
                return frame
            check_camera(Path(self.path), frame.color, given.camera)
            color, depth_m = given.rectification.color(frame.color), given.rectification.depth(frame.depth_m)
            frame = replace(frame, color=color, depth_m=depth_m, camera=given.camera)
            return self._steady(self._range[index], frame) if self._steady is not None else frame

    @cached_property
    def _steady(self) -> SteadyFrames | None:
        if self._given is None:
            return None
        later_ns = self._frames.depth_later_ns if isinstance(self._frames, RobotRecording) and self._given.depth_delay_s else None
        return self._given.steady_frames(self._look, later_ns)

    def _look(self, position: int) -> Look | None:
        """The look of a frame of the recording; None where there is none, or none that can be read."""
        frame, given = self._frames.frame(position) if position < len(self._frames) else None, self._given
        if frame is None or given is None or frame.color.shape[:2] != (given.camera.height, given.camera.width):
            return None
        return look_at(position, frame.stamp_ns, given.rectification.color(frame.color))

    def calibration(self) -> Calibration:
        """Return what the images are converted with: that of the camera file, or the camera that the recording states."""
        if self._given is not None:
            return self._given
        first = next(filter(None, map(self, range(len(self)))), None)
        if first is None:
            raise DataError(self.path, "holds no frame that can be read", "record them again")
        return Calibration(first.camera, self.depth_scale)

    def truth(self) -> Trajectory | None:
        """Return the attached ground truth, or that of `truth_from`."""
        with one_line_errors(self.path):
            return self._frames.truth()


def open_messages(path: Path) -> McapFile | BagFile:
    """Open a file of messages: an MCAP file, a bag of ROS 1, or a folder of rosbag2. Raises RecordingError where it is none."""
    refuse_video(path)
    if path.suffix == BAG or (path / METADATA_FILE).is_file():
        return BagFile(path, ROS)
    inside = sorted(path.glob("*.mcap")) if path.is_dir() else []
    return McapFile(inside[0] if len(inside) == 1 else path)


class _Recorded:
    """The embedded frames of a recording of this program; a frame's number is its place in it."""

    def __init__(self, recording: Recording) -> None:
        if "dataset" not in recording.topics:
            raise DataError(str(recording.path), "holds no frames", "record them with record.frames=true, or use trihedron convert")
        self._recording = recording
        self._stamps = [value.stamp_ns for value in recording.values("frames")]

    def __len__(self) -> int:
        return len(self._stamps)

    def frame(self, position: int) -> Frame | None:
        """Read the frame at a place, as it was."""
        value = self._recording.value("dataset", self._stamps[position])
        return replace(value, index=position) if isinstance(value, Frame) else None

    def truth(self) -> Trajectory | None:
        """Return the attached ground truth."""
        return attached_truth(self._recording.attachments, str(self._recording.path))
