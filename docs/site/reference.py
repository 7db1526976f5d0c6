"""Write the pages of the reference that are generated from the program: the command line and the configuration."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import re
from enum import Enum
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from plugin_pages import markdown

from trihedron.pipeline.app.cli import COMMAND_GROUP, main
from trihedron.pipeline.core.comments import field_comments
from trihedron.pipeline.core.config import FoxgloveView, RecordOptions, RerunView, RunOptions, SearchOptions

ROOT = Path(__file__).resolve().parents[2]
GROUPS = {"graph": "Systems", "experiment": "Sweeps with a table at their end", "without": "The default graph without one ingredient"}
HEAD = """# The configuration

Words of the command line are `key=value`. A key is one of those on this page, a stage (`manhattan=branch_and_bound`), an option of a stage
(`manhattan.cone_deg=8`; see [Plugins](plugins.md)), a wire (`graph.tracks.manhattan=manhattan@prev`), or one of Hydra's own.
"""
TITLE = re.compile(r"# @package _global_\n((?:#.*\n)+)")

PYTHON = """# Python: classes and functions

Docstrings of the names in `import trihedron as th`. [The Python API](python.md) introduces them.

## Track, record, replay

::: trihedron.slam.Slam
    options: {members: [track, values, map, trajectory, causal_trajectory, mesh, building, save, save_map, close]}
::: trihedron.recording.Recording
    options: {members: [topics, metadata, values, frame, image, frames, poses, trajectory, map, mesh, building, replay, ablate]}
::: trihedron.runs.run
::: trihedron.runs.Run
::: trihedron.runs.compare
::: trihedron.ablations.ablate
::: trihedron.ablations.Ablation
::: trihedron.camera.Camera
::: trihedron.trajectory.Trajectory
::: trihedron.buildings.Building

## Stages and plugins

::: trihedron.stages.Slot
::: trihedron.stages.StageFactory
    options: {members: [__call__]}
::: trihedron.stages.Stage
    options: {members: [__call__]}
::: trihedron.pipeline.core.registry.register
::: trihedron.pipeline.core.errors.TrihedronError

## Values

::: trihedron.pipeline.core.types
    options: {show_root_heading: false, show_root_toc_entry: false, show_if_no_docstring: false, filters: ["!^_"]}
"""


def command_line() -> str:
    """Every command with its help."""
    names = ["run", *sorted(entry.name for entry in entry_points(group=COMMAND_GROUP) if entry.module.startswith("trihedron."))]
    blocks = [f"## trihedron {name}\n\n```text\n{command_output(name, '--help')}\n```\n" for name in names]
    head = "# The command line\n\nThis page is what `trihedron COMMAND --help` prints. Exit codes are listed in [The run folder](run-folder.md).\n\n"
    return head + "\n".join(blocks)


def command_output(*words: str) -> str:
    """The output of a command, as wide as a page."""
    stream = io.StringIO()
    with contextlib.redirect_stdout(stream), contextlib.suppress(SystemExit):
        main(list(words))
    return stream.getvalue().rstrip()


def configuration() -> str:
    """Root keys with their defaults, and the files of each group."""
    parts = [
        HEAD,
        "## Root keys\n\n" + table(RunOptions, skipped=("defaults", "graph", "hydra", "record", "view")),
        "## record\n\n" + (inspect.getdoc(RecordOptions) or "") + "\n\n" + table(RecordOptions, "record."),
        "## view=foxglove\n\n" + table(FoxgloveView, "view."),
        "## view=rerun\n\n" + table(RerunView, "view."),
        "## hydra/sweeper=optuna\n\n" + table(SearchOptions, "hydra.sweeper.", skipped=("_target_",)),
    ]
    for group, what in (
        ("graph", "Systems"),
        ("experiment", "Sweeps with a table at their end"),
        ("without", "The default graph without one ingredient"),
    ):
        rows = [
            (f"`{group}={path.stem}`", f"[{path.stem}.yaml](../../conf/{group}/{path.name})", about(path))
            for path in sorted((ROOT / "conf" / group).glob("*.yaml"))
        ]
        parts.append(f"## {group}\n\n{what}.\n\n" + markdown(["word", "file", "content"], rows))
    return "\n\n".join(parts) + "\n"


def table(options: type[Any], prefix: str = "", skipped: tuple[str, ...] = ()) -> str:
    """Fields of a dataclass: name, default, comment."""
    comments, rows = field_comments(options), []
    for field in dataclasses.fields(options):
        if field.name not in skipped:
            default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
            shown = default.name if isinstance(default, Enum) else "" if default is None else str(default)
            rows.append((f"`{prefix}{field.name}`", f"`{shown}`" if shown else "–", comments.get(field.name, "")))
    return markdown(["key", "default", "meaning"], rows)


def about(path: Path) -> str:
    """The first comment of a file of configuration, as one line; no commands."""
    found = TITLE.match(path.read_text())
    lines = [line.lstrip("# ") for line in (found[1] if found else "").splitlines() if not line.startswith("#   ")]
    return " ".join(lines)


def pages() -> dict[str, str]:
    """Text of each generated page by its place below docs/."""
    return {"reference/python-objects.md": PYTHON, "reference/command-line.md": command_line(), "reference/configuration.md": configuration()}
