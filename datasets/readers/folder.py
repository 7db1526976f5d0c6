"""Any folder with a subfolder of colour images and one of depth images."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from trihedron.datasets.readers.association import Stamps, associate
from trihedron.datasets.readers.cameras import choose_calibration, with_noise
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader, open_folder, select_frames
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.options import Frames, PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.record.trajectories import TRUTH, parse_stamp_ns, read_trajectory

COLOR_FOLDERS = ("rgb", "color", "colour", "image")  # beginnings of names, the first that fits
DEPTH_FOLDERS = ("depth",)
IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm"}
SECONDS = re.compile(r"\d+\.\d+")
EPOCH_NS = {13: 1_000_000, 16: 1_000, 19: 1}  # digits of a name that counts ms, µs or ns since 1970 -> ns of one unit
MAX_FRAME_DIGITS = 9  # a longer whole number is no frame number


@register("dataset", "folder")
@dataclass(frozen=True)
class Folder(SequenceReader):
    """Registered images in rgb|color|colour|image* and depth*, with a camera.yaml, and a groundtruth.txt where there is truth.

    Names that are seconds with a decimal point, or ms, µs, ns since 1970, are the stamps; a whole number is a frame number; otherwise
    the position counts. Pairs have the same name; names in seconds that differ are paired by time, other names by their order."""

    path: str = ""  # folder of the sequence
    frames: Frames = ""  # part to read, half open: A:B, A:, :B; empty = all
    camera: str = ""  # preset or camera.yaml; empty = the folder's file, else its name
    max_difference_ms: PositiveFloat = 20.0  # of the stamps of a pair whose names differ
    exact_depth: bool = False  # rendered without sensor noise; false = a Kinect's

    @cached_property
    def _sequence(self) -> ImageSequence:
        folder = open_folder(self.path)
        colors, depths = _pair(
            folder,
            _images(folder, COLOR_FOLDERS, "colour"),
            _images(folder, DEPTH_FOLDERS, "depth"),
            round(self.max_difference_ms * 1e6),
        )
        calibration = with_noise(choose_calibration(folder, self.camera), self.exact_depth)
        truth = folder / TRUTH
        whole = ImageSequence(
            _stamps(colors, calibration.camera.fps),
            colors,
            depths,
            calibration,
            read_trajectory(truth) if truth.is_file() else None,
        )
        return select_frames(whole, self.frames, str(folder))


def _images(folder: Path, names: tuple[str, ...], kind: str) -> list[Path]:
    """The image files of the first subfolder whose name begins with one of `names`, in natural order (2 before 10)."""
    subfolders = sorted((entry for entry in folder.iterdir() if entry.is_dir()), key=lambda entry: (len(entry.name), entry.name))
    found = next((entry for name in names for entry in subfolders if entry.name.lower().startswith(name)), None)
    if found is None:
        raise DataError(str(folder), f"has no subfolder of {kind} images", f"call it {' or '.join(names)}")
    files = sorted((file for file in found.iterdir() if file.suffix.lower() in IMAGES), key=_natural)
    if not files:
        raise DataError(str(found), "holds no images", "put the images there as .png (depth must be 16-bit)")
    return files


def _natural(file: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.findall(r"\d+|\D+", file.stem)]


def _pair(folder: Path, colors: list[Path], depths: list[Path], max_difference_ns: int) -> tuple[list[Path], list[Path]]:
    """By equal names; else by time; else by order."""
    by_name = {file.stem: file for file in depths}
    common = [file for file in colors if file.stem in by_name]
    if common:
        return common, [by_name[file.stem] for file in common]
    if all(SECONDS.fullmatch(file.stem) for file in colors + depths):
        pairs = associate(_stamps(colors, 1.0), _stamps(depths, 1.0), max_difference_ns)
        if len(pairs):
            return [colors[i] for i in pairs[:, 0]], [depths[i] for i in pairs[:, 1]]
    if len(colors) != len(depths):
        cause = f"{len(colors)} colour and {len(depths)} depth images have no name in common"
        raise DataError(str(folder), cause, "give the two images of a pair the same name")
    return colors, depths


def _stamps(files: list[Path], fps: float) -> Stamps:
    """Stamps in ns from the names when they say so and increase, else from the position."""
    names = [file.stem for file in files]
    digits = len(names[0])
    if all(SECONDS.fullmatch(name) for name in names):
        stamps = [parse_stamp_ns(name) for name in names]
    elif digits in EPOCH_NS and all(name.isdigit() and len(name) == digits for name in names):
        stamps = [int(name) * EPOCH_NS[digits] for name in names]
    elif all(name.isdigit() and len(name) <= MAX_FRAME_DIGITS for name in names):
        stamps = [round(int(name) * 1e9 / fps) for name in names]
    else:
        stamps = [round(position * 1e9 / fps) for position in range(len(names))]
    found = np.array(stamps, dtype=np.int64)
    return found if (np.diff(found) > 0).all() else np.rint(np.arange(len(names)) * 1e9 / fps).astype(np.int64)
