"""Rendered sequences of the Replica scenes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.datasets.readers.cameras import Calibration, choose_calibration, with_noise
from trihedron.datasets.readers.matrices import files_by_number, frame_stamps, matrix, trajectory_of
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import MAX_YAML_BYTES, read_text
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Camera, Trajectory
from trihedron.pipeline.record.trajectories import table_lines

PARAMETERS = "cam_params.json"
KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")
LARGEST = 1 << 16


@register("dataset", "replica")
@dataclass(frozen=True)
class Replica(SequenceReader):
    """Folder with results/frame000000.jpg, results/depth000000.png and traj.txt, 16 numbers of `T_world_camera` a line (the export used by
    iMAP and NICE-SLAM; x right, y down, z forward). cam_params.json lies in it or beside it. Frames are 1/30 s apart, depth is exact."""

    camera: str = ""  # preset or camera.yaml; empty = the folder's file, else cam_params.json
    exact_depth: bool = True  # rendered without sensor noise; false = a Kinect's

    def _open(self, folder: Path) -> ImageSequence:
        colors = files_by_number(folder / "results", r"frame(\d+)\.(?:jpg|png)")
        depths = files_by_number(folder / "results", r"depth(\d+)\.png")
        numbers = [number for number in colors if number in depths]
        if not numbers:
            raise DataError(str(folder), "holds no frames of Replica", "give the folder that holds results/frame000000.jpg and depth000000.png")
        calibration = self._calibration(folder)
        stamps = frame_stamps(numbers, calibration.camera.fps)
        images = [colors[n] for n in numbers], [depths[n] for n in numbers]
        truth = _truth(folder / "traj.txt", calibration.camera.fps) if (folder / "traj.txt").is_file() else None
        return ImageSequence(stamps, *images, with_noise(calibration, self.exact_depth), truth)

    def _calibration(self, folder: Path) -> Calibration:
        file = next((place / PARAMETERS for place in (folder, folder.absolute().parent) if (place / PARAMETERS).is_file()), None)
        return choose_calibration(folder, self.camera) if self.camera or file is None else read_parameters(file)


def _truth(path: Path, fps: float) -> Trajectory | None:
    """Row n is the pose of frame n."""
    rows = table_lines(path)
    places = [f"{path}:{line}" for line, _ in rows]
    poses = [matrix(words, place) for (_, words), place in zip(rows, places)]
    return trajectory_of(frame_stamps(range(len(poses)), fps), poses, places)


def read_parameters(path: Path) -> Calibration:
    """Read cam_params.json: `{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}`, depth value per metre last. Raises DataError."""
    try:
        camera: Any = json.loads(read_text(path, MAX_YAML_BYTES))["camera"]
        w, h, fx, fy, cx, cy, scale = (float(camera[key]) for key in KEYS)
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        raise DataError(str(path), "does not describe a camera", f"give {{'camera': {{{', '.join(KEYS)}}}}} with a number each") from error
    if not (np.isfinite([cx, cy]).all() and all(0.0 < x < np.inf for x in (fx, fy, scale)) and all(1 <= n < LARGEST and n % 1 == 0 for n in (w, h))):
        raise DataError(str(path), "does not describe a camera", "w, h, fx, fy and scale must be positive")
    return Calibration(Camera(int(w), int(h), fx, fy, cx, cy), scale)
