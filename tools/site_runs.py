"""The page of one run, from the files of its folder."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from trihedron.comparison.run_tables import FIGURES
from trihedron.comparison.runs import Run
from trihedron.pipeline.core.errors import DataError, RecordingError, TrihedronError
from trihedron.pipeline.core.files import MAX_YAML_BYTES, YamlError, file_sha256, parse_yaml, read_text
from trihedron.pipeline.core.types import Pose, Trajectory
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth, read_trajectory
from trihedron.pipeline.run.result_files import read_results
from trihedron.tools import site_figures
from trihedron.tools.site_pages import render
from trihedron.tools.site_pictures import embed_picture

RECORDING, TRAJECTORY, SURFACE = "run.mcap", "trajectory.txt", "surface.ply"
CONFIGURATION = Path(".hydra") / "config.yaml"
NOT_REPEATED = ("out", "hydra.sweep.dir")  # of the words of a command


@dataclass(frozen=True)
class RunFacts:
    """A run with what its recording and configuration tell: commit, program version, words of its command, graph, data and number of frames."""

    run: Run
    commit: str
    version: str
    words: tuple[str, ...]
    config: dict[str, Any]
    frames: int

    @property
    def folder_name(self) -> str:
        """Return the name of the data set's folder; empty for the synthetic room."""
        return Path(str((self.config.get("dataset") or {}).get("path") or "")).name

    @property
    def graph(self) -> str:
        """Return the graph of the run's words; the default where they name none."""
        return next((word.partition("=")[2] for word in self.words if word.startswith("graph=")), "structural")

    @property
    def command(self) -> str:
        """Return the command that computes the run again, into a folder `again`."""
        words = [word for word in self.words if word.lstrip("+~").partition("=")[0] not in NOT_REPEATED]
        checkout = f"git checkout {self.commit}\n" if self.commit else ""
        return checkout + shlex.join(["trihedron", "run", *words, "out=again"]) + f"\nsha256sum again/{TRAJECTORY}"


def facts_of(run: Run) -> RunFacts:
    """Read what a run's recording and configuration tell; without a recording, its overrides alone."""
    config = _yaml(run.folder / CONFIGURATION)
    metrics = read_results(run.folder / "metrics.json")
    words = [f"{key}={value}" for key, value in run.overrides.items()]
    commit = version = ""
    try:
        metadata = Recording(run.folder / RECORDING).metadata
        commit, version = metadata.get("commit", ""), metadata.get("version", "")
        words = json.loads(metadata["overrides"])
    except (DataError, RecordingError, KeyError, ValueError):
        pass  # a run that failed has none, or a broken one
    return RunFacts(run, commit, version, tuple(map(str, words)), config, metrics.get("frames") or 0)


def run_page(facts: RunFacts, title: str, other_commit: bool, pictures: bool) -> str:
    """Return the page of a run as HTML."""
    folder = facts.run.folder
    estimate, truth, poses = _results(folder)
    figures: list[site_figures.Figure | None] = []
    view = None
    if estimate is not None:
        view = site_figures.scene(estimate, truth, folder / SURFACE)
        figures = [site_figures.path_figure(estimate, truth), site_figures.error_figure(estimate, truth) if truth is not None else None]
    if poses:
        seconds = [(pose.stamp_ns - poses[0].stamp_ns) / 1e9 for pose in poses]
        figures.append(site_figures.status_figure([pose.status for pose in poses], seconds))
    figures.append(site_figures.stage_figure(read_json(folder / "timing.json").get("stages", {})))
    return render(
        "run.html",
        title=title,
        other_commit=other_commit,
        commit=facts.commit,
        summary=_summary(facts),
        command=facts.command,
        checksums=[(name, file_sha256(folder / name)) for name in (TRAJECTORY, SURFACE, RECORDING) if (folder / name).is_file()],
        view=view,
        figures=[figure for figure in figures if figure is not None],
        pictures=_pictures(folder) if pictures and poses else [],
        config=yaml.safe_dump(facts.config, sort_keys=False),
    )


def _summary(facts: RunFacts) -> list[tuple[str, str]]:
    import math

    figures = [(name, f"{value:.{FIGURES[name].decimals}f}") for name, value in facts.run.figures.items() if math.isfinite(value)]
    note = [("note", facts.run.note)] if facts.run.note else []
    dataset = str((facts.config.get("dataset") or {}).get("plugin", ""))
    of_data = f"{dataset} {facts.folder_name}".strip() or "unknown"
    return [
        ("data", of_data),
        ("frames", str(facts.frames)),
        *figures,
        *note,
        ("commit", facts.commit or "unknown"),
        ("version", facts.version or "unknown"),
    ]


def _results(folder: Path) -> tuple[Trajectory | None, Trajectory | None, list[Pose]]:
    """Return final trajectory, ground truth and poses of a run; None and empty for what it lacks."""
    try:
        estimate = read_trajectory(folder / TRAJECTORY)
    except DataError:
        estimate = None
    try:
        recording = Recording(folder / RECORDING)
        truth = attached_truth(recording.attachments, str(recording.path))
        poses = [value for value in recording.values("pose") if isinstance(value, Pose)] if "pose" in recording.topics else []
    except (DataError, RecordingError):
        return estimate, None, []
    return estimate, truth, poses


def _pictures(folder: Path) -> list[dict[str, Any]]:
    """Return the middle frame with its features, and the map from above, as JPEG; none where the recording cannot be drawn."""
    from trihedron.comparison.pictures import draw

    with TemporaryDirectory() as temporary:
        file = Path(temporary) / "picture.png"
        try:
            draw(str(folder / RECORDING), -1, file)
        except TrihedronError:
            return []
        picture = embed_picture(file, "The middle frame with planes, 3D lines, key points and Manhattan axes; the map from above")
    return [picture] if picture else []


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; empty where there is none."""
    try:
        return read_results(path)
    except DataError:
        return {}


def _yaml(path: Path) -> dict[str, Any]:
    try:
        found = parse_yaml(read_text(path, MAX_YAML_BYTES))
    except (DataError, YamlError):
        return {}
    return found if isinstance(found, dict) else {}
