"""Scans of ScanNet, exported."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from trihedron.datasets.readers.cameras import Calibration
from trihedron.datasets.readers.images import read_color
from trihedron.datasets.readers.matrices import files_by_number, frame_stamps, pose_files, read_matrix
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader, first_size
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, U8, Camera

DEPTH_SCALE = 1000.0
LAYOUT = "give the folder of a scan exported with color/0.jpg, depth/0.png, pose/0.txt and intrinsic/"
WORTH_MOVING_PX = 0.1  # nearer than this, interpolating would blur colour more than it moves it


@register("dataset", "scannet")
@dataclass(frozen=True)
class ScanNet(SequenceReader):
    """Folder with color/0.jpg, depth/0.png (mm), pose/0.txt (camera to world; infinite where tracking was lost, a frame without truth) and
    intrinsic/intrinsic_color.txt, intrinsic_depth.txt, as the data set's SensReader exports them (Dai et al. 2017). Frames are 1/30 s apart.

    Depth is registered to colour, which is larger: colour is reduced to the depth camera, whose intrinsics a frame has."""

    def _open(self, folder: Path) -> ImageSequence:
        colors, depths = files_by_number(folder / "color", r"(\d+)\.(?:jpg|png)"), files_by_number(folder / "depth", r"(\d+)\.png")
        numbers = [number for number in colors if number in depths]
        if not numbers:
            raise DataError(str(folder), "holds no frames of ScanNet", LAYOUT)
        color_K, depth_K = (_intrinsics(folder / "intrinsic" / f"intrinsic_{kind}.txt") for kind in ("color", "depth"))
        height, width = first_size(list(depths.values()), DEPTH_SCALE)
        camera = Camera(width, height, float(depth_K[0, 0]), float(depth_K[1, 1]), float(depth_K[0, 2]), float(depth_K[1, 2]))
        stamps = frame_stamps(numbers, camera.fps)
        truth = pose_files(stamps, [folder / "pose" / f"{n}.txt" for n in numbers])
        images = [colors[n] for n in numbers], [depths[n] for n in numbers]
        reader = partial(_read_reduced, K=color_K, camera=camera)
        return ImageSequence(stamps, *images, Calibration(camera, DEPTH_SCALE), truth, color_reader=reader)


def _intrinsics(path: Path) -> F64:
    if not path.is_file():
        raise DataError(str(path), "is missing", LAYOUT)
    K = read_matrix(path)
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DataError(str(path), "holds no focal length", "give the intrinsics as the data set has them")
    return K[:3, :3]


def _read_reduced(path: Path, K: F64, camera: Camera) -> U8:
    """The colour image as the depth camera would see it; `K` is that of the image."""
    image = read_color(path)
    share = np.array([camera.width / image.shape[1], camera.height / image.shape[0]])
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA) if (share != 1.0).any() else image
    f, c = np.diag(K)[:2] * share, (K[:2, 2] + 0.5) * share - 0.5  # of the reduced image, pixel centres at integers
    stretch = f / (camera.fx, camera.fy)
    shift = c - stretch * (camera.cx, camera.cy)  # pixel of the reduced image = stretch · pixel of depth + shift
    corners = np.array([[0.0, 0.0], [camera.width - 1.0, camera.height - 1.0]])
    if np.abs(stretch * corners + shift - corners).max() < WORTH_MOVING_PX:
        return np.asarray(small, np.uint8)
    move = np.array([[stretch[0], 0.0, shift[0]], [0.0, stretch[1], shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(small, move, (camera.width, camera.height), flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8)
