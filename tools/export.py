"""Write what a run has found in a format that other programs read.

RUN is a run folder or its recording. Lengths are metres. tum and kitti are the final trajectory, csv is a row for each frame, colmap a model with its
images, rerun what `trihedron view` shows, all in the world of trajectory.txt. Meshes are
turned so that up, an axis of the Manhattan frame, is +z (ply, obj,
planes.json) or +y (gltf, a .glb file, by its standard), and what the first camera saw is ahead: +y, or -z.
With --covariance, tum is the poses as they were estimated at the time, and a file
beside it (.cov) their covariances, which smfeval judges. With --images, png has the colours of the images.

Example: trihedron export runs/latest --to colmap
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from trihedron.pipeline.app.recorded_values import open_recording
from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.pipeline.record.mcap_file import recording_file
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.arguments import Parser

BY_ENDING = {"glb": "gltf", "rrd": "rerun"}  # endings of files that are given for the names of their formats
OF_BUILDINGS = ("dxf", "ifc", "svg")  # formats of another command
FLAGS = {"covariance": "with the covariance of each pose (tum)", "images": "in the colours of the images, not of the planes (png)"}


@dataclass(frozen=True)
class Format:
    """One format: `write` makes the file and returns a line about its content."""

    name: str  # as given to --to
    file: str  # its default name, in the run folder
    write: Callable[[Recording, Path], str]
    variants: Mapping[str, Format] = field(default_factory=dict)  # name of a flag -> what is written with it


def formats() -> dict[str, Format]:
    """Every format by name."""
    from trihedron.tools import export_colmap, export_picture, export_rerun, export_surface, export_trajectory

    modules = (export_trajectory, export_colmap, export_surface, export_picture, export_rerun)
    return {format.name: format for module in modules for format in module.FORMATS}


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises UsageError for wrong arguments, DataError for a run that lacks what is to be written."""
    parser = Parser("export", __name__)
    parser.add_argument("run", metavar="RUN", type=Path, help="a run folder or its recording")
    parser.add_argument("--to", metavar="FORMAT", required=True, help=f"one of {', '.join(formats())}; glb and rrd too")
    parser.add_argument("--out", metavar="FILE", type=Path, help="(default: in the run folder)")
    for flag, meaning in FLAGS.items():
        parser.add_argument(f"--{flag}", action="store_true", help=meaning)
    arguments = parser.parse(argv)
    name = BY_ENDING.get(arguments.to, arguments.to)
    if name not in formats():
        plan = f"trihedron building {arguments.run} writes it" if name in OF_BUILDINGS else ""
        raise UsageError("export", f"there is no format '{name}'", plan or did_you_mean(name, formats()))
    chosen = formats()[name]
    for flag in (flag for flag in FLAGS if vars(arguments)[flag]):
        if flag not in chosen.variants:
            able = ", ".join(format.name for format in formats().values() if flag in format.variants)
            raise UsageError("export", f"--{flag} is not for the format '{name}'", f"give --to {able}, or leave out --{flag}")
        chosen = chosen.variants[flag]
    recording = recording_file(arguments.run)
    out: Path = arguments.out or recording.parent / chosen.file
    try:
        content = chosen.write(open_recording(recording), out)
    except OSError as error:
        raise DataError(str(out), f"cannot be written: {error.strerror}", "give another --out") from error
    print(f"{out}: {content}")
    return 0
