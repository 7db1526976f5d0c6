"""Trajectory files in the TUM format: one pose a line, `stamp tx ty tz qx qy qz qw`, `#` starts a comment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal, DecimalException
from pathlib import Path

import numpy as np

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import SHOWN, read_text, write_file
from trihedron.pipeline.core.geometry import pose_matrix, quaternion_from_rotation, rotation_from_quaternion
from trihedron.pipeline.core.types import F64, Trajectory

MAX_DISTANCE_M = 1e9  # from the origin; positions of GNSS are within 1e7 m
TRUTH = "groundtruth.txt"  # in a folder, and attached to a recording, so that a replay is judged without the folder
MAX_STAMP_S = 2**62 // 1_000_000_000  # what fits into 64 bits of nanoseconds
MAX_BYTES, MAX_LINES, MAX_LINE = 1 << 26, 1_000_000, 4096  # of a list or trajectory: bytes, lines, characters of a line
LAYOUT = "stamp tx ty tz qx qy qz qw"


def parse_stamp_ns(text: str) -> int:
    """Decimal seconds as text -> whole nanoseconds, without the rounding of a float. Raises ValueError for no number or too large a one."""
    try:
        seconds = Decimal(text)
        if abs(seconds) < MAX_STAMP_S:
            return int((seconds * 1_000_000_000).to_integral_value())
    except (DecimalException, ValueError) as error:  # its exponent may be anything
        raise ValueError(f"the time stamp '{printable(text, SHOWN)}' is not a number of seconds") from error
    raise ValueError(f"the time stamp '{printable(text, SHOWN)}' is too large for seconds: is it in nanoseconds?")


def format_stamp(stamp_ns: int) -> str:
    """Nanoseconds -> decimal seconds with nine digits; inverse of `parse_stamp_ns`."""
    sign, stamp_ns = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"


def table_lines(path: Path) -> list[tuple[int, list[str]]]:
    """The words of each line that is neither blank nor a comment, with its line number (from 1); commas and tabs separate like blanks.

    Raises DataError when the file cannot be read as text, or is larger than any list of frames."""
    return split_lines(read_text(path, MAX_BYTES), str(path))


def split_lines(text: str, place: str) -> list[tuple[int, list[str]]]:
    """`table_lines` of a text."""
    lines = text.splitlines()
    if len(lines) > MAX_LINES:
        raise DataError(place, f"has more than {MAX_LINES} lines", "give a shorter list")
    long = next((number for number, line in enumerate(lines, start=1) if len(line) > MAX_LINE), None)
    if long is not None:
        raise DataError(f"{place}:{long}", f"is longer than {MAX_LINE} characters", "give one entry a line")
    rows = ((number, line.split("#")[0].replace(",", " ").split()) for number, line in enumerate(lines, start=1))
    return [(number, words) for number, words in rows if words]


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory file as it stands. Raises DataError naming the file and line: unreadable, empty, too few columns, a number that is
    none or not finite, a zero quaternion, a stamp that does not come after the one before."""
    path = Path(path).expanduser()
    return parse_trajectory(table_lines(path), str(path))


def parse_trajectory(rows: list[tuple[int, list[str]]], source: str) -> Trajectory:
    """The trajectory in the lines of `source`; errors as in `read_trajectory`."""
    stamps: list[int] = []
    poses: list[F64] = []
    for number, words in rows:
        place = f"{source}:{number}"
        try:
            stamp_ns, pose = _parse_pose(words)
        except ValueError as error:
            raise DataError(place, str(error), f"each line holds '{LAYOUT}'; correct or remove this one") from error
        if stamps and stamp_ns <= stamps[-1]:
            raise DataError(
                place, f"the time stamp {printable(words[0], SHOWN)} does not come after the one before", "sort the file and remove duplicates"
            )
        stamps.append(stamp_ns)
        poses.append(pose)
    if not stamps:
        raise DataError(source, "holds no poses", f"give a file with a line '{LAYOUT}' for each pose")
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))


def _parse_pose(words: list[str]) -> tuple[int, F64]:
    if len(words) < 8:
        raise ValueError(f"has {len(words)} columns instead of 8")
    stamp_ns = parse_stamp_ns(words[0])
    try:
        values = np.array([float(word) for word in words[1:8]])
    except ValueError:
        raise ValueError("a column is not a number") from None
    if not np.isfinite(values).all():
        raise ValueError("the pose is not finite")
    if np.abs(values[:3]).max() > MAX_DISTANCE_M:
        raise ValueError(f"the position is beyond {MAX_DISTANCE_M:.0e} m")
    if math.hypot(*values[3:].tolist()) < 1e-3:
        raise ValueError("the quaternion is zero")
    return stamp_ns, pose_matrix(rotation_from_quaternion(values[3:]), values[:3])


def attached_truth(attachments: Mapping[str, str], source: str) -> Trajectory | None:
    """The ground truth among a recording's attached texts, or None."""
    text = attachments.get(TRUTH)
    return parse_trajectory(split_lines(text, place := f"{source}: {TRUTH}"), place) if text is not None else None


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory so that `read_trajectory` gives it back: stamps exactly, positions to 1e-9 m."""
    write_file(Path(path).expanduser(), format_trajectory(trajectory))


def format_trajectory(trajectory: Trajectory) -> str:
    """The text of a trajectory file."""
    lines = [f"# {LAYOUT}"]
    for stamp_ns, pose in zip(trajectory.stamps_ns, trajectory.poses):
        numbers = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
        lines.append(" ".join([format_stamp(int(stamp_ns)), *(f"{x:.9f}" for x in numbers)]))
    return "\n".join(lines) + "\n"
