"""Frames out of a robot's recording: ROS 2 messages or Foxglove's schemas in an MCAP file or a bag."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from trihedron.datasets.readers.association import Stamps, associate, pairs_with_delay
from trihedron.datasets.readers.picture_headers import UnreadableImage
from trihedron.datasets.readers.pixels import Kind, color_of, depth_of
from trihedron.datasets.readers.registration import Registration, Undistortion
from trihedron.datasets.readers.robot_streams import MessageFile, Role, Stream, Streams
from trihedron.datasets.readers.robot_values import Intrinsics, Link, Picture, UnreadableMessage
from trihedron.datasets.readers.transform_tree import TransformTree
from trihedron.pipeline.core.errors import DataError, RecordingError
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, Camera, Frame, Trajectory

log = logging.getLogger("trihedron")
RECTIFIED = re.compile(r"(^|[_/])rect")  # in the name of a topic, by the convention of image_proc
DISTORTION_MODELS = {"", "plumb_bob", "rational_polynomial", "thin_prism"}  # whose coefficients OpenCV takes in this order
COEFFICIENTS = (0, 4, 5, 8, 12, 14)
LARGEST = 1 << 14  # pixels of a side


@dataclass(frozen=True)
class Topics:
    """Topics given by the user; an empty one is chosen by its type."""

    color: str = ""
    depth: str = ""
    color_info: str = ""
    depth_info: str = ""
    truth: str = ""  # a topic of poses of the camera, or the name of the frame whose transforms lead to the camera


@dataclass(frozen=True)
class _Sample:
    """Coordinate frame, height and width of the images of a topic, from the first."""

    frame_id: str
    shape: tuple[int, int]


@dataclass(frozen=True)
class RobotRecording:
    """The frames of a recording, in any order and from any thread: colour paired with the nearest depth, undistorted, depth registered to colour."""

    file: MessageFile
    topics: Topics
    max_difference_ns: int
    depth_delay_ns: int
    depth_scale: float
    known_delay_s: float = 0.0  # of depth, in a pair by stamps alone

    def __len__(self) -> int:
        return len(self._pairs)

    def stamp_ns(self, position: int) -> int:
        """Return the stamp of a frame, that of its colour image."""
        return int(self._pairs[position, 0])

    @property
    def depth_later_ns(self) -> Stamps:
        """By how many ns the stamp of depth is later (n,), beyond the median of pairs by stamps alone, with which a known delay was estimated."""
        return self._pairs[:, 3]

    def frame(self, position: int) -> Frame | None:
        """The pair at a place; None, after a warning, where one of its images cannot be decoded."""
        stamp_ns, color_row, depth_row, _ = self._pairs[position].tolist()
        try:
            color = self._decode_image(self._color, color_row, self._first_color.shape)
            depth = self._decode_image(self._depth, depth_row, self._first_depth.shape)
        except (UnreadableImage, UnreadableMessage, RecordingError) as error:
            log.warning("%s; frame %d is skipped", error, position)
            return None
        return Frame(position, stamp_ns, self._undistortion.color(color), self._register_depth(depth), self.camera)

    def truth(self) -> Trajectory | None:
        """`T_world_camera` from the poses or transforms that were chosen. Raises DataError where there is none."""
        if not self.topics.truth:
            return None
        links = self._pose_links() if self.topics.truth.startswith("/") else self._frame_links()
        poses = {link.stamp_ns: link.T_parent_child for link in links}
        if not poses:
            raise DataError("dataset.truth_from", f"'{self.topics.truth}' does not give the camera at the times of the frames", "leave it out")
        stamps = sorted(poses)
        return Trajectory(np.array(stamps, np.int64), np.array([poses[stamp] for stamp in stamps]))

    @cached_property
    def camera(self) -> Camera:
        """The colour camera, undistorted."""
        found, K = self._color_intrinsics, _matrix(self._color_intrinsics, self._color.topic)
        steps = np.diff(self._pairs[:, 0])
        fps = round(1e9 / float(np.median(steps)), 3) if len(steps) else Camera.fps
        return Camera(found.width, found.height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), fps)

    # which topics

    @cached_property
    def _streams(self) -> Streams:
        return Streams(self.file)

    @cached_property
    def _color(self) -> Stream:
        return self._streams.images(Kind.color, "color_topic", self.topics.color)

    @cached_property
    def _depth(self) -> Stream:
        return self._streams.images(Kind.depth, "depth_topic", self.topics.depth)

    @cached_property
    def _pairs(self) -> Stamps:
        """(n, 4) stamp, row of colour, row of depth, and by how many ns the stamp of depth is later than in a usual pair; in order of time."""
        color, depth = _sort_stamps(self._color.stamps_ns()), _sort_stamps(self._depth.stamps_ns())
        depth_ns = depth[:, 0] + self.depth_delay_ns
        usual = associate(color[:, 0], depth_ns, self.max_difference_ns)
        pairs = pairs_with_delay(color[:, 0], depth_ns, self.max_difference_ns, self.known_delay_s) if self.known_delay_s else usual
        if not len(pairs):
            cause = f"no image of {self._color.topic} is within {self.max_difference_ns / 1e6:g} ms of one of {self._depth.topic}"
            raise DataError(str(self.file.path), cause, "raise dataset.max_difference_ms or give dataset.depth_delay_ms")
        first, second = pairs.T
        apart_ns, usual_ns = (depth_ns[those[:, 1]] - color[those[:, 0], 0] for those in (pairs, usual))
        return np.column_stack([color[first], depth[second, 1], apart_ns - (round(float(np.median(usual_ns))) if len(usual) else 0)])

    @cached_property
    def _color_intrinsics(self) -> Intrinsics:
        first = self._first_color
        found = self._streams.calibration(self._color, first.frame_id, "color_info_topic", self.topics.color_info)
        if found is None:
            there = ", ".join(stream.topic for stream in self._streams.of(Role.intrinsics))
            cure = f"choose one with dataset.color_info_topic=TOPIC: {there}" if there else "record the camera's calibration too"
            raise DataError(str(self.file.path), f"holds no camera intrinsics for {self._color.topic}", cure)
        _check(found, self._color.topic, first.shape, str(self.file.path))
        return found

    @cached_property
    def _depth_intrinsics(self) -> Intrinsics | None:
        """Intrinsics of a separate depth camera; None where depth is registered to colour already."""
        color, first = self._color_intrinsics, self._first_depth
        found = self._streams.calibration(self._depth, first.frame_id, "depth_info_topic", self.topics.depth_info)
        if found is None:
            if first.shape != (color.height, color.width):
                cause = f"holds no camera intrinsics for {self._depth.topic}, whose images differ in size from {self._color.topic}"
                raise DataError(str(self.file.path), cause, "choose them with dataset.depth_info_topic=TOPIC")
            return None
        _check(found, self._depth.topic, first.shape, str(self.file.path))
        same = (found.width, found.height) == (color.width, color.height) and np.allclose(found.K, color.K, rtol=1e-6, atol=1e-6)
        T = self._T_color_depth
        return None if same and (T is None or np.allclose(T, np.eye(4), atol=1e-6)) else found

    @cached_property
    def _first_color(self) -> _Sample:
        return self._first(self._color)

    @cached_property
    def _first_depth(self) -> _Sample:
        return self._first(self._depth)

    def _first(self, stream: Stream) -> _Sample:
        """Describe the first image that can be decoded. Raises DataError where there is none."""
        why = "it is empty"
        for row in range(len(stream.index)):
            try:
                shape = self._decode_image(stream, row).shape
                return _Sample(stream.at(row).frame_id, (shape[0], shape[1]))
            except (UnreadableImage, UnreadableMessage, RecordingError) as error:
                why = str(error)
        raise DataError(str(self.file.path), f"no image of {stream.topic} can be read: {why}", "record them again, or name another topic")

    def _decode_image(self, stream: Stream, row: int, shape: tuple[int, int] | None = None) -> Any:
        try:
            picture: Picture = stream.at(row)
            pixels = color_of(picture) if stream is self._color else depth_of(picture, self.depth_scale)
            if shape is not None and pixels.shape[:2] != shape:
                raise UnreadableImage(f"is {pixels.shape[1]}×{pixels.shape[0]} while the first is {shape[1]}×{shape[0]}")
        except (UnreadableImage, UnreadableMessage) as error:
            raise UnreadableImage(f"{self.file.path}: image {row} of {stream.topic} {error}") from error
        return pixels

    # geometry

    @cached_property
    def _tree(self) -> TransformTree:
        """All transforms of the recording; those of topics that are called static are constant."""
        fixed: list[Link] = []
        moving: list[Link] = []
        for stream in self._streams.of(Role.links):
            (fixed if "static" in stream.topic else moving).extend(link for value in stream.values() for link in value)
        return TransformTree(fixed, moving)

    @cached_property
    def _T_color_depth(self) -> F64 | None:
        color, depth = self._first_color.frame_id, self._first_depth.frame_id
        return np.eye(4) if color.lstrip("/") == depth.lstrip("/") else self._tree.lookup(color, depth)

    @cached_property
    def _registration(self) -> Registration | None:
        found = self._depth_intrinsics
        if found is None:
            return None
        if self._T_color_depth is None:
            color, depth = self._first_color.frame_id, self._first_depth.frame_id
            cause = f"holds no transform from '{depth}' to '{color}', which registering depth to colour needs"
            raise DataError(str(self.file.path), cause, "record /tf_static too, or the topic of registered depth")
        K = _matrix(found, self._depth.topic)
        return Registration(found.width, found.height, K, _distortion(found, self._depth.topic), self._T_color_depth, self.camera)

    def _register_depth(self, depth: F32) -> F32:
        return self._registration(depth) if self._registration is not None else self._undistortion.depth(depth)

    @cached_property
    def _undistortion(self) -> Undistortion:
        return Undistortion(self.camera, _distortion(self._color_intrinsics, self._color.topic))

    # truth

    def _frame_links(self) -> list[Link]:
        """The camera in the frame that was named, at each colour image for which the transforms give it."""
        world, camera = self.topics.truth, self._first_color.frame_id
        stamps = self._pairs[:, 0].tolist()
        found = [(stamp, self._tree.lookup(world, camera, stamp)) for stamp in stamps]
        return [Link(stamp, world, camera, T) for stamp, T in found if T is not None]

    def _pose_links(self) -> list[Link]:
        """The poses of a topic, transformed to the camera where the transforms give its mounting."""
        camera, found = self._first_color.frame_id, []
        for value in self._streams.stream_named(self.topics.truth, "truth_from", Role.pose).values():
            for link in value:
                mount = self._tree.lookup(link.child, camera) if link.child else None
                found.append(link if mount is None else Link(link.stamp_ns, link.parent, camera, matmul(link.T_parent_child, mount)))
        return found


def _sort_stamps(stamps: Stamps) -> Stamps:
    """(n, 2) stamp and row of the messages that have a stamp, increasing, of equal stamps the first."""
    unique, rows = np.unique(stamps, return_index=True)
    return np.column_stack([unique, rows])[unique >= 0]


def _is_rectified(found: Intrinsics, topic: str) -> bool:
    return bool(RECTIFIED.search(topic)) and bool(found.P[0, 0] > 0 and found.P[1, 1] > 0)


def _matrix(found: Intrinsics, topic: str) -> F64:
    """(3, 3) of the images of a topic: rectified ones have another."""
    return np.asarray(found.P[:, :3] if _is_rectified(found, topic) else found.K)


def _distortion(found: Intrinsics, topic: str) -> tuple[float, ...]:
    return found.D if any(found.D) and not _is_rectified(found, topic) else ()


def _check(found: Intrinsics, topic: str, shape: tuple[int, ...], place: str) -> None:
    """Raise DataError for intrinsics that the images, or OpenCV, cannot go with."""
    if (found.height, found.width) != shape[:2] or max(shape[:2]) > LARGEST:
        cause = f"the images of {topic} are {shape[1]}×{shape[0]}, their intrinsics are of {found.width}×{found.height}"
        raise DataError(place, cause, "choose the intrinsics of these images")
    distortion = _distortion(found, topic)
    if distortion and (found.model not in DISTORTION_MODELS or len(distortion) not in COEFFICIENTS):
        cause = f"the distortion model '{found.model[:40]}' of {topic} with {len(distortion)} coefficients is not known"
        raise DataError(place, cause, f"known: {', '.join(sorted(DISTORTION_MODELS - {''}))}; rectify the images first")
