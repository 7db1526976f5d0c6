"""Sequences of the ICL-NUIM benchmark, in both published layouts.

The published camera has fy = -480: its y axis points up. Here the poses are reflected with S = diag(1, -1, 1),
`R -> S R S`, `t -> S t`, and fy is +480, which is the same geometry with y down. Stamps are the image numbers, as in the published
trajectory files: one image is one second in them, though the nominal rate is 30 images a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trihedron.datasets.readers import povray
from trihedron.datasets.readers.association import Stamps, file_inside
from trihedron.datasets.readers.cameras import Calibration, choose_calibration, with_noise
from trihedron.datasets.readers.images import read_depth
from trihedron.datasets.readers.matrices import files_by_number
from trihedron.datasets.readers.sequence import DepthReader, ImageSequence, SequenceReader
from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import SHOWN
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, F64, Trajectory
from trihedron.pipeline.record.trajectories import TRUTH, parse_stamp_ns, read_trajectory, table_lines

REFLECTION = np.diag([1.0, -1.0, 1.0, 1.0])
MIN_DEPTH_M = 0.1  # the benchmark's noise model writes smaller values where it has none
SECOND_NS = 1_000_000_000


@register("dataset", "icl_nuim")
@dataclass(frozen=True)
class IclNuim(SequenceReader):
    """Folder of the TUM-compatible layout (rgb/, depth/, associations.txt, groundtruth.txt or *.freiburg) or of POV-Ray's own
    (scene_00_0000.png, .depth, .txt) (Handa et al. 2014). Images without a pose, such as image 0, are frames without truth."""

    camera: str = ""  # preset or camera.yaml; empty = the folder's file, else the benchmark's camera
    exact_depth: bool = False  # for the sequences published without noise; false = a Kinect's

    def _open(self, folder: Path) -> ImageSequence:
        calibration = with_noise(choose_calibration(folder, self.camera, default="icl_nuim"), self.exact_depth)
        reader: DepthReader
        if any(folder.glob(povray.DEPTH_FILES)):
            scene = povray.read_scene(folder)
            numbers, colors, depths, truth = scene.numbers, scene.color_files, scene.depth_files, scene.truth
            reader = povray.depth_reader(calibration.camera)
        else:
            numbers, colors, depths = _associations(folder) if (folder / "associations.txt").is_file() else _numbered_pairs(folder)
            truth, reader = _truth_file(folder), _png_reader(calibration)
        return ImageSequence(numbers, colors, depths, calibration, _reflect_trajectory(truth), depth_reader=reader)


def _reflect_trajectory(truth: Trajectory | None) -> Trajectory | None:
    return None if truth is None else Trajectory(truth.stamps_ns, reflect(truth.poses))


def reflect(poses: F64) -> F64:
    """(n, 4, 4) poses with y up -> with y down (the reflection is its own inverse)."""
    return matmul(REFLECTION, poses, REFLECTION)


def _associations(folder: Path) -> tuple[Stamps, list[Path], list[Path]]:
    """Image numbers, colour and depth files of associations.txt: `number file number file`, depth or colour first."""
    path = folder / "associations.txt"
    numbers: list[int] = []
    colors: list[Path] = []
    depths: list[Path] = []
    for line, words in table_lines(path):
        place = f"{path}:{line}"
        depth_first = len(words) >= 4 and "depth" in words[1]
        if len(words) < 4 or ("depth" in words[3]) == depth_first:
            raise DataError(place, "does not name a depth and a colour file", "each line holds 'number depth/FILE number rgb/FILE'")
        try:
            number = parse_stamp_ns(words[2] if depth_first else words[0])
        except ValueError as error:
            raise DataError(place, str(error), "each line begins with the image's number") from error
        if numbers and number <= numbers[-1]:
            raise DataError(place, f"image {printable(words[0], SHOWN)} does not come after the one before", "sort the list and remove duplicates")
        numbers.append(number)
        colors.append(file_inside(folder, words[3 if depth_first else 1], place))
        depths.append(file_inside(folder, words[1 if depth_first else 3], place))
    if not numbers:
        raise DataError(str(path), "lists no images", "give a list with a line 'number depth/FILE number rgb/FILE' for each pair")
    return np.array(numbers, dtype=np.int64), colors, depths


def _numbered_pairs(folder: Path) -> tuple[Stamps, list[Path], list[Path]]:
    """The pairs rgb/N.png, depth/N.png, in order of N."""
    colors, depths = files_by_number(folder / "rgb", r"(\d+)\.png"), files_by_number(folder / "depth", r"(\d+)\.png")
    numbers = [number for number in colors if number in depths]
    if not numbers:
        cure = "give the folder that holds rgb/0.png and depth/0.png, or scene_00_0000.png and .depth"
        raise DataError(str(folder), "holds no image pairs of either ICL-NUIM layout", cure)
    return np.array(numbers, dtype=np.int64) * SECOND_NS, [colors[n] for n in numbers], [depths[n] for n in numbers]


def _truth_file(folder: Path) -> Trajectory | None:
    """groundtruth.txt, or the one *.freiburg file; stamps are image numbers."""
    if (folder / TRUTH).is_file():
        return read_trajectory(folder / TRUTH)
    found = sorted(folder.glob("*.freiburg"))
    if len(found) > 1:
        raise DataError(str(folder), f"holds several trajectories: {', '.join(file.name for file in found)}", "keep the one of this sequence")
    return read_trajectory(found[0]) if found else None


def _png_reader(calibration: Calibration) -> DepthReader:
    def read(path: Path) -> F32:
        depth = read_depth(path, calibration.depth_scale)
        depth[depth < MIN_DEPTH_M] = 0.0
        return depth

    return read
