"""Time-stamped lists of image files, and the association of two of them."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import SHOWN
from trihedron.pipeline.core.geometry import nearest_pairs
from trihedron.pipeline.record.trajectories import parse_stamp_ns, table_lines

log = logging.getLogger("trihedron")
LEAST_PAIRED = 0.9  # of the images that the stamps alone pair
Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class FileList:
    """Image files with their (n,) stamps in ns, strictly increasing."""

    stamps_ns: Stamps
    files: tuple[Path, ...]


def read_file_list(path: Path) -> FileList:
    """Read `stamp file` lines (TUM's rgb.txt, depth.txt); files are relative to the list's folder. Raises DataError naming file and line."""
    stamps: list[int] = []
    files: list[Path] = []
    for number, words in table_lines(path):
        place = f"{path}:{number}"
        if len(words) < 2:
            raise DataError(place, f"has {len(words)} column instead of 2", "each line holds 'stamp file'; correct or remove this one")
        try:
            stamp_ns = parse_stamp_ns(words[0])
        except ValueError as error:
            raise DataError(place, str(error), "each line holds 'stamp file'; correct or remove this one") from error
        if stamps and stamp_ns <= stamps[-1]:
            raise DataError(
                place, f"the time stamp {printable(words[0], SHOWN)} does not come after the one before", "sort the list and remove duplicates"
            )
        stamps.append(stamp_ns)
        files.append(file_inside(path.parent, words[1], place))
    if not stamps:
        raise DataError(str(path), "lists no images", "give a list with a line 'stamp file' for each image")
    return FileList(np.array(stamps, dtype=np.int64), tuple(files))


def without_missing(listed: FileList, path: Path) -> FileList:
    """The images of a list that are there; one warning counts those that are not. Raises DataError when none is."""
    there = np.array([os.path.isfile(file) for file in listed.files])
    if there.all():
        return listed
    if not there.any():
        raise DataError(str(path), f"names {len(there)} images, of which none is there", "unpack the images beside the list")
    missing = np.flatnonzero(~there)
    first = printable(listed.files[missing[0]].name, SHOWN)
    log.warning("%s: %d of the %d images it names are missing, the first is %s; they are skipped", path, len(missing), len(there), first)
    return FileList(listed.stamps_ns[there], tuple(file for file, found in zip(listed.files, there) if found))


def file_inside(folder: Path, name: str, place: str) -> Path:
    """The file of a list that lies with its images. Raises DataError, naming `place`, for one that is somewhere else: a list from
    a stranger must not reach the rest of the disk. (What a link in the folder points to is its owner's affair.)"""
    if os.path.isabs(name) or os.path.normpath(name).split(os.sep)[0] == os.pardir:
        raise DataError(place, f"the file '{printable(name, SHOWN)}' is outside the folder of the list", "put the images below that folder")
    return folder / name


def associate(first_ns: Stamps, second_ns: Stamps, max_difference_ns: int) -> NDArray[np.int64]:
    """Pair two increasing lists of stamps, each entry at most once, the closest pairs first (the rule of the TUM benchmark's tools).

    Returns the (n, 2) row numbers of the pairs, in order of time; the difference of a pair is below `max_difference_ns`. Ties go to the
    earlier row, so the result does not depend on anything but the stamps."""
    return nearest_pairs(first_ns, second_ns, max_difference_ns - 1)


def pairs_with_delay(color_ns: Stamps, depth_ns: Stamps, max_difference_ns: int, known_delay_s: float) -> NDArray[np.int64]:
    """Pair as `associate` does, depth that was taken `known_delay_s` after its stamps; by the stamps alone where few images are so near then, as at a
    low rate: depth is turned to the time of its colour."""
    by_stamps = associate(color_ns, depth_ns, max_difference_ns)
    if not known_delay_s:
        return by_stamps
    by_times = associate(color_ns, depth_ns + round(known_delay_s * 1e9), max_difference_ns)
    return by_times if len(by_times) >= LEAST_PAIRED * len(by_stamps) else by_stamps


def count_unpaired(folder: Path, colors: int, pairs: int, where: str = "") -> None:
    """Warn of colour images that have no depth image, which are skipped."""
    if pairs < colors:
        log.warning("%s: %d of the %d colour images have no depth image%s; they are skipped", folder, colors - pairs, colors, where)


class ListedPairs(NamedTuple):
    """Pairs of images: stamps of colour (n,), colour files, depth files, and by how many ns the stamp of depth is later (n,)."""

    stamps_ns: Stamps
    color_files: list[Path]
    depth_files: list[Path]
    depth_later_ns: Stamps


def listed_pairs(folder: Path, max_difference_ms: float, depth_delay_ms: float, known_delay_s: float) -> ListedPairs:
    """Pair the images of rgb.txt and depth.txt by time. `depth_delay_ms` is added to the stamps of depth, which was taken `known_delay_s` later
    still. Raises DataError where a list is missing or nothing pairs."""
    for name, kind in (("rgb.txt", "colour"), ("depth.txt", "depth")):
        if not (folder / name).is_file():
            raise DataError(str(folder / name), "is missing", f"it lists the {kind} images; without lists use dataset=folder")
    lists = [read_file_list(folder / name) for name in ("rgb.txt", "depth.txt")]
    color, depth = (without_missing(listed, folder / name) for listed, name in zip(lists, ("rgb.txt", "depth.txt")))
    depth_ns = depth.stamps_ns + round(depth_delay_ms * 1e6)
    pairs = pairs_with_delay(color.stamps_ns, depth_ns, round(max_difference_ms * 1e6), known_delay_s)
    if not len(pairs):
        cause = f"no colour and depth image are within {max_difference_ms:g} ms of each other"
        raise DataError(str(folder), cause, "check the stamps in rgb.txt and depth.txt or raise dataset.max_difference_ms")
    count_unpaired(folder, len(color.files), len(pairs), f" within {max_difference_ms:g} ms")
    first, second = pairs.T
    later_ns = depth_ns[second] - color.stamps_ns[first]
    return ListedPairs(color.stamps_ns[first], [color.files[i] for i in first], [depth.files[i] for i in second], later_ns)
