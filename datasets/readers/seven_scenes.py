"""Sequences of the 7-Scenes data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from trihedron.datasets.readers.cameras import KINECT_READOUT_S, Calibration, choose_calibration
from trihedron.datasets.readers.images import read_depth
from trihedron.datasets.readers.matrices import files_by_number, frame_stamps, pose_files
from trihedron.datasets.readers.sequence import DepthReader, ImageSequence, SequenceReader
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, Trajectory

INVALID_M = 65.0  # 65535 mm stands for no reading
LAYOUT = "give the folder that holds frame-000000.color.png or .jpg, .depth.png and .pose.txt, for example chess/seq-01"


@register("dataset", "seven_scenes")
@dataclass(frozen=True)
class SevenScenes(SequenceReader):
    """Folder with frame-000000.color.png or .jpg, .depth.png (mm) and .pose.txt (camera to world) (Shotton et al. 2013). Frames are 1/30 s apart.

    The published depth is *not* registered to colour: it is a camera of its own, of focal length 585 and centre (320, 240), and no calibration of the
    pair was published. Colour is taken to be that of a usual Kinect (focal length 525, 25 mm to the right), to which depth is registered, with
    `sigmas` as single Kinects differ; a camera.yaml replaces both. The published poses are those of the depth camera, and become those of colour."""

    camera: str = ""  # preset or camera.yaml; empty = the folder's file, else the data set's camera

    def _open(self, folder: Path) -> ImageSequence:
        colors = files_by_number(folder, r"frame-(\d+)\.color\.(?:png|jpe?g)")
        depths = files_by_number(folder, r"frame-(\d+)\.depth\.png")
        numbers = [number for number in colors if number in depths]
        if not numbers:
            inside = sorted(entry.name for entry in folder.glob("seq-*") if entry.is_dir())
            raise DataError(str(folder), "holds no frames of 7-Scenes", f"choose one of {', '.join(inside)}" if inside else LAYOUT)
        calibration = choose_calibration(folder, self.camera, "seven_scenes", KINECT_READOUT_S)
        stamps = frame_stamps(numbers, calibration.camera.fps)
        truth = pose_files(stamps, [folder / f"frame-{n:06}.pose.txt" for n in numbers])
        if truth is not None and calibration.depth_camera is not None:
            truth = Trajectory(truth.stamps_ns, matmul(truth.poses, invert(calibration.depth_camera.T_color_depth)))
        images = [colors[n] for n in numbers], [depths[n] for n in numbers]
        return ImageSequence(stamps, *images, calibration, truth, depth_reader=_reader(calibration))


def _reader(calibration: Calibration) -> DepthReader:
    def read(path: Path) -> F32:
        depth = read_depth(path, calibration.depth_scale)
        depth[depth > INVALID_M] = 0.0
        return depth

    return read
