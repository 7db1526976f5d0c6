"""Data sets by the files of their folders."""

from __future__ import annotations

from pathlib import Path

from trihedron.pipeline.core.errors import DataError

RECORDING = ".mcap"
BAG = ".bag"  # of a ROS 1 bag
FILES = {RECORDING: "mcap", BAG: "mcap", ".r3d": "record3d"}  # ending of a file -> data set plugin
SOURCES = "a folder, a {}, {} or {} file".format(*FILES)
METADATA_FILE = "metadata.yaml"  # of a rosbag2 folder
LAYOUTS = {  # data set plugin -> patterns: of each group one must be there
    "mcap": ((METADATA_FILE,),),
    "tum": (("rgb.txt",), ("depth.txt",)),
    "icl_nuim": (("associations.txt", "*.freiburg", "scene_*.depth"),),
    "seven_scenes": (("frame-*.color.*",),),
    "replica": (("traj.txt",), ("results/",)),
    "stray_scanner": (("odometry.csv",), ("rgb.mp4",)),
    "scannet": (("intrinsic/intrinsic_depth.txt",),),
}


def layout_of(source: Path) -> str:
    """Return the data set plugin whose layout a folder has, by its ending that of a file, `folder` for any other folder. Raises DataError."""
    if source.is_file() and source.suffix in FILES:
        return FILES[source.suffix]
    if not source.is_dir():
        cause = "is not a folder or a recording" if source.exists() else "does not exist"
        raise DataError(str(source), cause, f"give {SOURCES}")
    return next((name for name, groups in LAYOUTS.items() if all(any(_holds(source, pattern) for pattern in group) for group in groups)), "folder")


def data_set_words(word: str) -> list[str]:
    """Return a word of the command line that is a path instead of key=value as overrides that choose the data set by its files; another as it is."""
    if "=" in word or word.startswith(("-", "~", "+")) or not (path := Path(word)).exists():
        return [word]
    return [f"dataset={layout_of(path)}", f"dataset.path={word}"]


def _holds(folder: Path, pattern: str) -> bool:
    """Return whether a folder has a file of a pattern; with a slash at its end, a folder."""
    return any(path.is_dir() if pattern.endswith("/") else path.is_file() for path in folder.glob(pattern.rstrip("/")))
