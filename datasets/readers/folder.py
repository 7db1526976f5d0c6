"""Any folder with a subfolder of colour images and one of depth images."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from trihedron.datasets.readers.association import Stamps, count_unpaired, pairs_with_delay
from trihedron.datasets.readers.cameras import choose_calibration, with_noise
from trihedron.datasets.readers.matrices import MAX_DIGITS
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.record.trajectories import TRUTH, parse_stamp_ns, read_trajectory

COLOR_FOLDERS = ("rgb", "color", "colour", "image")  # beginnings of names, the first that fits
DEPTH_FOLDERS = ("depth",)
IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm"}
SECONDS = re.compile(r"\d+\.\d+")
EPOCH_NS = {13: 1_000_000, 16: 1_000, 19: 1}  # digits of a name that counts ms, µs or ns since 1970 -> ns of one unit
MAX_NAME = 32  # digits of a name that is a number
LAST_NS = 2**62  # of a stamp
log = logging.getLogger("trihedron")


@register("dataset", "folder")
@dataclass(frozen=True)
class Folder(SequenceReader):
    """Registered images in rgb|color|colour|image* and depth*, with a camera.yaml, and a groundtruth.txt where there is truth.

    Names that are seconds with a decimal point, or ms, µs, ns since 1970, are the stamps; a whole number is a frame number; otherwise
    the position counts. Pairs have the same name; names in seconds that differ are paired by time, names that end in a number (rgb00002.png beside
    depth00002.png, in subfolders or not) by that, other names by their order."""

    camera: str = ""  # preset or camera.yaml; empty = the folder's file, else its name
    max_difference_ms: PositiveFloat = 20.0  # of the stamps of a pair whose names differ
    exact_depth: bool = False  # rendered without sensor noise; false = a Kinect's

    def _open(self, folder: Path) -> ImageSequence:
        colors, depths = _images(folder, COLOR_FOLDERS, "colour"), _images(folder, DEPTH_FOLDERS, "depth")
        found = len(colors)
        calibration = with_noise(choose_calibration(folder, self.camera), self.exact_depth)
        names, colors, depths, later_ns = _pair(folder, colors, depths, round(self.max_difference_ms * 1e6), calibration.depth_delay_s)
        count_unpaired(folder, found, len(colors))
        truth = read_trajectory(folder / TRUTH) if (folder / TRUTH).is_file() else None
        return ImageSequence(_stamps(names, calibration.camera.fps), colors, depths, calibration, truth, depth_later_ns=later_ns)


def _images(folder: Path, names: tuple[str, ...], kind: str) -> list[Path]:
    """The image files of the first subfolder whose name begins with one of `names`, else those of the folder itself whose names do, in natural
    order (2 before 10)."""
    subfolders = sorted((entry for entry in folder.iterdir() if entry.is_dir()), key=lambda entry: (len(entry.name), entry.name))
    found = next((entry for name in names for entry in subfolders if entry.name.lower().startswith(name)), None)
    files = [file for file in (found or folder).iterdir() if file.suffix.lower() in IMAGES and (found or file.name.lower().startswith(names))]
    if not files and found is None:
        raise DataError(str(folder), f"has no subfolder of {kind} images", f"call it {' or '.join(names)}")
    if not files:
        raise DataError(str(found), "holds no images", "put the images there as .png (depth must be 16-bit)")
    return sorted(files, key=_natural)


def _natural(file: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() and len(part) <= MAX_NAME else (-1, part) for part in re.findall(r"\d+|\D+", file.stem)]


def _pair(
    folder: Path, colors: list[Path], depths: list[Path], max_difference_ns: int, delay_s: float
) -> tuple[list[str], list[Path], list[Path], Stamps | None]:
    """Names, colour and depth files of the pairs: by equal names; else by time, with the ns by which the stamp of depth is later than that of colour;
    else by the number that ends a name; else by order."""
    by_name = {file.stem: file for file in depths}
    common = [file for file in colors if file.stem in by_name]
    if common:
        return [file.stem for file in common], common, [by_name[file.stem] for file in common], None
    names = [file.stem for file in colors]
    if all(SECONDS.fullmatch(file.stem) for file in colors + depths):
        color_ns, depth_ns = _stamps(names, 1.0), _stamps([file.stem for file in depths], 1.0)
        first, second = pairs_with_delay(color_ns, depth_ns, max_difference_ns, delay_s).T
        if len(first):
            later_ns = depth_ns[second] - color_ns[first]
            return [names[i] for i in first], [colors[i] for i in first], [depths[i] for i in second], later_ns
    color_numbers, depth_numbers = _numbers(colors), _numbers(depths)
    shared = sorted(color_numbers.keys() & depth_numbers.keys())
    if shared:
        return [str(n) for n in shared], [color_numbers[n] for n in shared], [depth_numbers[n] for n in shared], None
    if len(colors) != len(depths):
        cause = f"{len(colors)} colour and {len(depths)} depth images have no name in common"
        raise DataError(str(folder), cause, "give the two images of a pair the same name")
    _warn_of_times(folder, names, [file.stem for file in depths])
    return names, colors, depths, None


def _warn_of_times(folder: Path, colors: list[str], depths: list[str]) -> None:
    """Warn where images that are paired by their order have names that are times, most of them more than half a frame apart."""
    if len(colors) < 2 or not all(SECONDS.fullmatch(name) or (name.isdecimal() and len(name) in EPOCH_NS) for name in colors + depths):
        return
    color_ns = _stamps(colors, 1.0)
    apart_ns = np.abs(color_ns - _stamps(depths, 1.0))
    count = int(np.count_nonzero(apart_ns > 0.5 * np.median(np.diff(color_ns))))
    if 2 * count > len(colors):
        cause = "%s: by their names the colour and depth of %d of %d frames are more than half a frame apart, by %.1f ms (median); "
        cure = "remove images without a partner, and give the two of a pair the same name"
        log.warning(cause + cure, folder, count, len(colors), float(np.median(apart_ns)) / 1e6)


def _numbers(files: list[Path]) -> dict[int, Path]:
    """The files by the number that ends each name (rgb00002.png); empty where the names differ in anything else."""
    found = [re.fullmatch(r"(.*?)(\d{1,9})", file.stem) for file in files]
    if len({match and match[1] for match in found}) > 1:
        return {}
    return {int(match[2]): file for match, file in zip(found, files) if match}


def _stamps(names: list[str], fps: float) -> Stamps:
    """Stamps in ns from the names where they state them and increase, else from the position."""
    digits = len(names[0])
    stamps: list[int] = []
    if all(SECONDS.fullmatch(name) and len(name) <= MAX_NAME for name in names):
        stamps = [parse_stamp_ns(name) for name in names]
    elif digits in EPOCH_NS and all(name.isdecimal() and len(name) == digits for name in names):
        stamps = [int(name) * EPOCH_NS[digits] for name in names]
    elif all(name.isdecimal() and len(name) <= MAX_DIGITS for name in names):
        stamps = [round(int(name) * 1e9 / fps) for name in names]
    if not stamps or max(stamps) >= LAST_NS or any(a >= b for a, b in pairwise(stamps)):
        stamps = [round(position * 1e9 / fps) for position in range(len(names))]
    return np.array(stamps, dtype=np.int64)
