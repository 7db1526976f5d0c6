"""Convert a data set to a recording: one MCAP file with the frames, lossless, and the ground truth if there is one.

SRC is a folder in one of the layouts of `trihedron plugins dataset`, recognised by its files, or a recording with embedded frames. The result is
run with dataset=mcap dataset.path=DST.mcap, and opens in Foxglove. A recording or map of an older format is upgraded instead: topics that cannot be
read are listed and skipped; a replay computes them anew.

Example: trihedron convert rgbd_dataset_freiburg3_structure_notexture_far far.mcap
"""

from __future__ import annotations

import inspect
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.errors import ConfigError, UsageError, printable
from trihedron.tools.arguments import Parser

if TYPE_CHECKING:
    from trihedron.pipeline.record.writer import RecordingWriter

SUFFIX = ".mcap"


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises UsageError for wrong arguments, DataError and RecordingError for what cannot be read."""
    parser = Parser("convert", __name__)
    parser.add_argument("source", metavar="SRC", type=Path, help="folder of a data set, or a recording with embedded frames")
    parser.add_argument("destination", metavar="DST.mcap", type=Path)
    parser.add_argument("--dataset", metavar="NAME", help="the layout, when it is not recognised: tum, icl_nuim, folder, ...")
    parser.add_argument("--camera", metavar="PRESET|FILE", help="as dataset.camera of trihedron run")
    parser.add_argument("--frames", metavar="A:B[:S]", default="", help="only this half-open range of frames, or every S-th of it")
    parser.add_argument("--overwrite", action="store_true", help="replace DST.mcap if it exists")
    arguments = parser.parse(argv)
    destination: Path = arguments.destination
    if destination.suffix != SUFFIX:
        raise UsageError("convert", f"'{destination}' does not end in {SUFFIX}", f"give for example {destination.name or 'far'}{SUFFIX}")
    if destination.exists() and not arguments.overwrite:
        raise UsageError(str(destination), "exists", "give another name or --overwrite")
    if arguments.source.suffix == SUFFIX and arguments.source.is_file() and not arguments.dataset and _upgrade_file(arguments.source, destination):
        return 0
    options = {"path": str(arguments.source), "frames": arguments.frames, "camera": arguments.camera}
    frames, unreadable = convert(arguments.dataset or layout_of(arguments.source), options, destination)
    skipped = f", {unreadable} could not be read" if unreadable else ""
    print(f"{destination}: {frames} frames, {destination.stat().st_size / 1e6:.1f} MB{skipped}")
    return 0


def _upgrade_file(source: Path, destination: Path) -> bool:
    """Upgrade a recording or map of an older format; returns False for any other file."""
    from trihedron.pipeline.record.upgrade import is_outdated, upgrade

    if not is_outdated(source):
        return False
    result = upgrade(source, destination)
    print(f"{destination}: upgraded {result.messages} messages, {destination.stat().st_size / 1e6:.1f} MB")
    for topic, why in sorted(result.skipped.items()):
        print(f"  skipped {printable(topic, 80)}: {printable(why, 300)}")
    return True


def layout_of(source: Path) -> str:
    """The data set plugin whose layout a folder has, `mcap` for a recording or bag. Raises DataError for neither, and for a video."""
    from trihedron.datasets.readers.sequence import refuse_video
    from trihedron.pipeline.core import layouts

    if source.suffix != SUFFIX:
        refuse_video(source)
    return layouts.layout_of(source)


def convert(dataset: str, options: dict[str, str | None], destination: Path) -> tuple[int, int]:
    """Write the recording; a file of that name is replaced only when all is done. Returns how many frames are in it and how many were unreadable.

    Raises DataError when the data set cannot be read, ConfigError for options it does not have."""
    from trihedron.pipeline.core.graph import build_graph
    from trihedron.pipeline.core.registry import load_plugins, plugin_class
    from trihedron.pipeline.record.mcap_writer import new_recording
    from trihedron.pipeline.record.trajectories import TRUTH, format_trajectory
    from trihedron.pipeline.record.writer import RecordingWriter
    from trihedron.pipeline.run.runner import Runner

    load_plugins()
    plugin = _plugin(plugin_class("dataset", dataset), dataset, options)
    runner = Runner(build_graph({"dataset": plugin}, ["dataset"]), frames=options["frames"] or "")
    truth = plugin.truth()
    with new_recording(destination, "give another DST.mcap") as new:
        writer = RecordingWriter(new, _metadata(destination))
        if truth is not None:
            writer.attach(TRUTH, format_trajectory(truth))
        _write(runner, writer)
    return len(runner.result.stamps_ns), runner.result.unreadable


def _plugin(kind: type[Any], name: str, options: dict[str, str | None]) -> Any:
    known = inspect.signature(kind).parameters
    given = {option: value for option, value in options.items() if value}
    for option in given:
        if option not in known:
            raise ConfigError(f"dataset={name}", f"has no option '{option}'", f"leave out --{option}")
    try:
        return kind(**given)
    except ValueError as error:
        field, _, cause = str(error).partition(": ")
        raise ConfigError(f"--{field}", cause, "see trihedron convert --help") from error


def _write(runner: Any, writer: RecordingWriter) -> None:
    from tqdm import tqdm

    steps = runner.steps(writer, frozenset({"dataset"}), embed_frames=True)
    try:
        for _ in tqdm(steps, total=len(runner.indices), unit="frame", disable=None, file=sys.stderr):
            pass
    finally:
        writer.close()


def _metadata(destination: Path) -> dict[str, str]:
    """Describe the recording as the run a replay starts from: its data set is the recording itself."""
    from importlib.metadata import version

    import yaml

    from trihedron.pipeline.core.overrides import quote

    path = str(destination.resolve())
    overrides, config = ["dataset=mcap", f"dataset.path={quote(path)}"], {"dataset": {"plugin": "mcap", "path": path}}
    return {"version": version("trihedron"), "commit": "", "overrides": json.dumps(overrides), "config": yaml.safe_dump(config)}
