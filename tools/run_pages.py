"""Facts, figures, plans and pictures of runs, from the files of their folders, and the page of one run."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import yaml

from trihedron.comparison.run_tables import FIGURES
from trihedron.comparison.runs import Run
from trihedron.pipeline.core.errors import DataError, RecordingError, TrihedronError
from trihedron.pipeline.core.files import MAX_YAML_BYTES, YamlError, file_sha256, parse_yaml, read_text
from trihedron.pipeline.core.geometry import transform, umeyama, upright
from trihedron.pipeline.core.registry import drawing_of
from trihedron.pipeline.core.types import F64, Building, Pose, Surface, Trajectory, Value
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth, read_trajectory
from trihedron.pipeline.run.metrics import FEWEST_POSES, aligned_errors, associate
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.run.results import TRAJECTORY
from trihedron.plugins.building.files import summary
from trihedron.plugins.building.svg import floorplan_svg
from trihedron.plugins.surface.files import SURFACE
from trihedron.tools.page_figures import (
    DASHES,
    TRUTH,
    CameraPath,
    curves_figure,
    embed_picture,
    encode,
    look_of,
    model_mesh,
    path_figure,
    scene,
    stage_figure,
    status_figure,
    surface_mesh,
)
from trihedron.tools.pages import render

V = TypeVar("V", bound=Value)
TRUTH_LOOK = ("ground truth", TRUTH, DASHES[1])
MOST_TRIANGLES = 10_000  # of a surface; there is a page for each run
MOST_PICTURES = 12  # a page of a large sweep would be too big to open
CONFIGURATION = Path(".hydra") / "config.yaml"
NOT_REPEATED = ("out", "hydra.sweep.dir")  # of the words of a command


@dataclass(frozen=True)
class RunFacts:
    """A run with what its files tell: commit, program version, words of its command, graph, data, number of frames, and the median σ of the positions
    of its poses with the status ok, NaN where it states none."""

    run: Run
    commit: str
    version: str
    words: tuple[str, ...]
    config: dict[str, Any]
    frames: int
    sigma_mm: float = np.nan

    @property
    def _dataset(self) -> dict[str, Any]:
        found = self.config.get("dataset")
        return found if isinstance(found, dict) else {}

    @property
    def folder_name(self) -> str:
        """Return the name of the data set's folder; empty for the synthetic room."""
        return Path(str(self._dataset.get("path") or "")).name

    @property
    def data_name(self) -> str:
        """Return the name of the data set's folder, or the scene of the simulation."""
        return self.folder_name or str(self._dataset.get("scene") or self._dataset.get("plugin") or "data")

    @property
    def data_set(self) -> str:
        """Return the data set's plugin and folder."""
        return f"{self._dataset.get('plugin', '')} {self.folder_name}".strip() or "unknown"

    @property
    def is_pushed(self) -> bool:
        """Say if the frames came from a Python program, so that no command repeats the run."""
        return self._dataset.get("plugin") == "pushed" and not any(word.startswith("replay=") for word in self.words)

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
        recording = Recording(run.folder / RECORDING)
        commit, version = recording.metadata.get("commit", ""), recording.metadata.get("version", "")
        words = recording.overrides()
    except (DataError, RecordingError):
        pass  # a run that failed has none, or a broken one
    sigma_m = (metrics.get("sigma") or {}).get("median_m")
    return RunFacts(run, commit, version, tuple(words), config, metrics.get("frames") or 0, np.nan if sigma_m is None else 1e3 * sigma_m)


@dataclass(frozen=True)
class Results:
    """Final trajectory, ground truth and recording of a run; None for what it lacks."""

    estimate: Trajectory | None
    truth: Trajectory | None = None
    recording: Recording | None = None

    def values(self, topic: str, kind: type[V]) -> list[V]:
        """Return the recorded values of a topic; none where the recording has none, or is broken there."""
        try:
            found = self.recording.values(topic) if self.recording is not None and topic in self.recording.topics else ()
            return [value for value in found if isinstance(value, kind)]
        except RecordingError:
            return []

    @property
    def true_positions_m(self) -> F64 | None:
        """Return the true positions (n, 3) at the poses of the trajectory, in its world; None for fewer than three."""
        poses, expected, _ = self._pairs
        return transform(umeyama(expected[:, :3, 3], poses[:, :3, 3]), expected[:, :3, 3]) if len(poses) >= FEWEST_POSES else None

    @property
    def errors_mm(self) -> tuple[F64, F64]:
        """Return seconds, and distances of the positions from the ground truth after SE(3) alignment; both empty for fewer than three."""
        poses, expected, seconds = self._pairs
        return (seconds, 1e3 * aligned_errors(poses, expected)) if len(poses) >= FEWEST_POSES else (np.empty(0), np.empty(0))

    @cached_property
    def _pairs(self) -> tuple[F64, F64, F64]:
        """Return the poses that have a true one, these, and their seconds since the first pose."""
        if self.estimate is None or self.truth is None:
            return np.empty((0, 4, 4)), np.empty((0, 4, 4)), np.empty(0)
        ours, true = associate(self.estimate.stamps_ns, self.truth.stamps_ns).T
        stamps_ns = self.estimate.stamps_ns
        return self.estimate.poses[ours], self.truth.poses[true], (stamps_ns[ours] - stamps_ns[0]) / 1e9


def results_of(folder: Path) -> Results:
    """Read the results of a run."""
    try:
        estimate = read_trajectory(folder / TRAJECTORY)
    except DataError:
        estimate = None
    try:
        recording = Recording(folder / RECORDING)
        return Results(estimate, attached_truth(recording.attachments, str(recording.path)), recording)
    except (DataError, RecordingError):
        return Results(estimate)


def drawings_of(folders: Mapping[str, Path], triangles: int = MOST_TRIANGLES) -> dict[str, Any]:
    """Return what a page draws of runs, by the names they have there: the 3D `view`, None without a trajectory, `figures`, their `looks` and the
    `plans` of buildings. A path is in the world of its run, the ground truth in that of the first run that has one."""
    runs = {name: results_of(folder) for name, folder in folders.items()}
    surface = next((found for run in runs.values() for found in run.values("surface", Surface)), None)
    buildings = {name: found for name, run in runs.items() for found in run.values("building", Building)}
    R_view_world = upright(surface.up if surface is not None else np.full(3, np.nan))
    looks = [(name, *look_of(number)) for number, name in enumerate(runs)]
    places = [(looks[k], run.estimate.poses[:, :3, 3], max(5 - k, 2)) for k, run in enumerate(runs.values()) if run.estimate is not None]
    truth = [(TRUTH_LOOK, found, 0) for run in runs.values() if (found := run.true_positions_m) is not None]
    paths = [CameraPath(*look, found @ R_view_world.T, dot_px) for look, found, dot_px in (*places, *truth[:1])]  # a later one on those before
    model = [model_mesh(drawing_of(building).solids, R_view_world, surface is None) for building in list(buildings.values())[:1]]
    meshes = [mesh for mesh in (surface_mesh(surface, triangles) if surface is not None else None, *model) if mesh is not None]
    curves = [run.errors_mm for run in runs.values()]
    figures = [path_figure(paths) if paths else None]
    figures.append(curves_figure("Position error", "mm", curves) if any(len(seconds) for seconds, _ in curves) else None)
    poses = [pose for run in runs.values() for pose in run.values("pose", Pose)] if len(runs) == 1 else []
    figures.append(status_figure([one.status for one in poses], [(one.stamp_ns - poses[0].stamp_ns) / 1e9 for one in poses]) if poses else None)
    figures.append(stage_figure([read_json(folder / "timing.json").get("stages") or {} for folder in folders.values()]))
    return {
        "view": scene(paths, meshes) if paths else None,
        "figures": [figure for figure in figures if figure is not None],
        "looks": [*looks, *([TRUTH_LOOK] if truth else [])],
        "plans": [_plan(name, building) for name, building in list(buildings.items())[:MOST_PICTURES]],
    }


def _plan(name: str, building: Building) -> dict[str, Any]:
    picture = {"kind": "svg+xml", "data": encode(floorplan_svg(building, name).encode()), "alt": f"Floor plan of {name}"}
    return {"text": f"{name}: {summary(building)}", "picture": picture}


def frame_picture(folder: Path) -> dict[str, Any]:
    """Return the middle frame of a run with its features, and the map from above. Raises TrihedronError when the recording cannot be drawn."""
    from trihedron.comparison.pictures import draw

    with TemporaryDirectory() as temporary:
        file = Path(temporary) / "picture.png"
        draw(str(folder / RECORDING), -1, file)
        return embed_picture(file, "The middle frame with planes, 3D lines, key points and Manhattan axes; the map from above")


def run_page(facts: RunFacts, title: str, other_commit: bool, pictures: bool, configurations: dict[str, Any]) -> str:
    """Return the page of a run as HTML, with a table of its configuration."""
    folder = facts.run.folder
    try:
        frames = [frame_picture(folder)] if pictures else []
    except TrihedronError:
        frames = []  # without a recording there is no picture
    return render(
        "run.html",
        title=title,
        other_commit=other_commit,
        commit=facts.commit,
        summary=_summary(facts),
        command=facts.command,
        checksums=[(name, file_sha256(folder / name)) for name in (TRAJECTORY, SURFACE, RECORDING) if (folder / name).is_file()],
        frames=[{"text": found["alt"], "picture": found} for found in frames if found],
        configurations=configurations,
        config=yaml.safe_dump(facts.config, sort_keys=False),
        **drawings_of({"ours": folder}),
    )


def _summary(facts: RunFacts) -> list[tuple[str, str]]:
    import math

    figures = [(name, f"{value:.{FIGURES[name].decimals}f}") for name, value in facts.run.figures.items() if math.isfinite(value)]
    figures += [("σ mm", f"{facts.sigma_mm:.2f}")] if math.isfinite(facts.sigma_mm) else []
    note = [("note", facts.run.note)] if facts.run.note else []
    return [
        ("data", facts.data_set),
        ("frames", str(facts.frames)),
        *figures,
        *note,
        ("commit", facts.commit or "unknown"),
        ("version", facts.version or "unknown"),
    ]


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
