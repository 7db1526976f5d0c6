"""Write one page of HTML about some runs: trajectories, surface and building in 3D, floor plans, errors over time, times of the stages, what the
configurations differ in, and a frame of each run with its features, planes and axes.

The page needs no network: everything, the drawing library too, is in the file. FOLDER is a run, or a sweep.

Example: trihedron report runs/a runs/b --out report.html
"""

from __future__ import annotations

import base64
import html
import json
import shlex
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison import run_tables as comparison_table
from trihedron.comparison.runs import Run, read_runs, rows_of
from trihedron.pipeline.core.drawings import drawing_of
from trihedron.pipeline.core.errors import DataError, TrihedronError
from trihedron.pipeline.core.files import MAX_YAML_BYTES, YamlError, parse_yaml, read_text
from trihedron.pipeline.core.geometry import transform, umeyama
from trihedron.pipeline.core.types import F64, Building, Trajectory
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth, read_trajectory
from trihedron.pipeline.run.metrics import aligned_errors, associate
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.run.results import flatten_dict
from trihedron.pipeline.run.stated_sigma import CAUSES, dominant_cause
from trihedron.plugins.building.files import floorplan_svg, summary
from trihedron.tools.arguments import Parser
from trihedron.tools.export_surface import surface_of

MOST_PICTURES = 12  # a page of a large sweep would be too big to open
TITLE_NAMES = 6
MOST_TRIANGLES = 60_000
STYLE = (
    "body{font:15px sans-serif;margin:2em auto;max-width:1100px;color:#222}h2{margin:1.6em 0 .4em;font-size:1.15em}table{border-collapse:collapse}"
    "td,th{padding:3px 10px;text-align:right;border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}"
    "figure{margin:1em 0}img{width:100%}.origins td{text-align:left}"
)
COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b", "#e377c2")  # of the runs, in all figures
LEGEND = {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"}
EYE = (0.5, 0.9, -1.2)  # to the right of, above and behind what the first camera sees, in sizes of the scene


def main(argv: list[str]) -> int:
    """Write the page and say where; returns the exit code. Raises DataError when there are no runs."""
    parser = Parser("report", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of runs, or of a sweep")
    parser.add_argument("--out", type=Path, default=Path("report.html"), metavar="FILE", help="default report.html")
    parser.add_argument("--title", metavar="TEXT", help="default: the data set and the names of the runs")
    options = parser.parse_args(argv)
    runs = [run for folder in options.folders for run in read_runs(folder)]
    options.out.write_text(page(runs, options.title), encoding="utf-8")
    print(options.out)
    return 0


def page(runs: Sequence[Run], title: str | None = None) -> str:
    """The whole page, under a title. Raises DataError when no run has a trajectory."""
    from plotly.offline import get_plotlyjs

    drawn = {name: run for name, run in zip(_names(runs), runs) if (run.folder / "run.mcap").exists() and (run.folder / "trajectory.txt").exists()}
    if not drawn:
        raise DataError(str(runs[0].folder), "none of the runs has a trajectory", "run with outputs=[trajectory]")
    colors = {name: COLORS[number % len(COLORS)] for number, name in enumerate(drawn)}
    paths, errors = _trajectories(drawn, colors)
    surface, up = _surface(drawn)
    figures = {
        "Trajectories and surface": (paths + surface + _model(drawn), {"scene": _scene(up), "height": 560}),
        "Position error over time": (errors, {"xaxis": {"title": {"text": "s"}}, "yaxis": {"title": {"text": "mm"}}, "height": 320}),
        "Stages, median time": (_stages(drawn, colors), {"barmode": "group", "yaxis": {"title": {"text": "ms"}}, "height": 320}),
    }
    body = [f"<h2>{about}</h2>{_figure(number, *figure)}" for number, (about, figure) in enumerate(figures.items()) if figure[0]]
    title = html.escape(title or title_of(drawn))
    parts = [
        f"<h1>{title}</h1>",
        _origins(drawn),
        "<h2>Results</h2>",
        _table(runs),
        _sigmas(drawn),
        *body,
        *_plans(drawn),
        "<h2>Configurations</h2>",
        _configurations(drawn),
        "<h2>Frames</h2>",
        *_pictures(drawn),
    ]
    head = f"<meta charset='utf-8'><title>{title}</title><link rel='icon' href='data:,'><style>{STYLE}</style><script>{get_plotlyjs()}</script>"
    return f"<!doctype html><html><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def title_of(runs: dict[str, Run]) -> str:
    """The data sets of the runs and their names."""
    names = list(runs)
    data = ", ".join(dict.fromkeys(_data_set(run) for run in runs.values()))
    return f"{data}: {', '.join(names[:TITLE_NAMES])}" + (f" and {len(names) - TITLE_NAMES} more" if len(names) > TITLE_NAMES else "")


def _data_set(run: Run) -> str:
    options = _config(run).get("dataset") or {}
    name = Path(str(options.get("path") or "")).name
    return f"{options.get('plugin', '-')} {name}".strip()


def _origins(runs: dict[str, Run]) -> str:
    """Name, data set, date and command of each run."""
    lines = ["".join(f"<th>{name}</th>" for name in ("run", "data set", "date", "command"))]
    for name, run in runs.items():
        recording, written = Recording(run.folder / "run.mcap"), (run.folder / ".hydra" / "config.yaml").stat().st_mtime
        date = datetime.fromtimestamp(written).astimezone().strftime("%Y-%m-%d %H:%M %Z")
        command = shlex.join(["trihedron", "run", *recording.overrides()])
        lines.append("".join(f"<td>{html.escape(text)}</td>" for text in (name, _data_set(run), date, command)))
    return "<table class='origins'>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def _names(runs: Sequence[Run]) -> list[str]:
    """The folders' names, with those above them where one is not enough."""
    names = [run.folder.resolve().name for run in runs]
    return names if len(set(names)) == len(names) else ["/".join(run.folder.resolve().parts[-2:]) for run in runs]


def _figure(number: int, traces: list[dict[str, Any]], layout: dict[str, Any]) -> str:
    layout = {**layout, "margin": {"l": 50, "r": 10, "t": 30, "b": 40}, "legend": LEGEND, "showlegend": True}
    text = json.dumps([traces, layout, {"displaylogo": False, "responsive": True}]).replace("</", "<\\/")
    return f"<div id='figure{number}'></div><script>Plotly.newPlot('figure{number}', ...{text})</script>"


def _table(runs: Sequence[Run]) -> str:
    header, cells = comparison_table.cells_of(rows_of(runs))
    lines = ["".join(f"<th>{html.escape(name)}</th>" for name in header)]
    for row in cells:
        texts = [f"<b>{html.escape(cell.text)}</b>" if cell.best else html.escape(cell.text) for cell in row]
        lines.append("".join(f"<td>{text}</td>" for text in texts))
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def _sigmas(runs: dict[str, Run]) -> str:
    """σ that each run states of its ok poses, and what has the largest share of it; nothing where no run states any."""
    found = {name: read_results(run.folder / "metrics.json").get("sigma") or {} for name, run in runs.items()}
    if not any(found.values()):
        return ""
    header = ("run", "σ mm, median", "worst", "σ deg, median", "worst", "mostly")
    figures = {"median_m": 1e3, "worst_m": 1e3, "median_deg": 1.0, "worst_deg": 1.0}
    lines = ["".join(f"<th>{name}</th>" for name in header)]
    for name, sigma in found.items():
        cells = [f"{factor * sigma[key]:.2f}" if sigma.get(key) is not None else "-" for key, factor in figures.items()]
        lines.append("".join(f"<td>{html.escape(text)}</td>" for text in (name, *cells, CAUSES.get(dominant_cause(sigma), "-"))))
    return "<h2>Stated uncertainty of ok poses</h2><table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def _trajectories(runs: dict[str, Run], colors: dict[str, str]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Paths in the world of the first run, with the truth where there is one, and errors in mm over seconds."""
    paths, errors = [], []
    for name, run in runs.items():
        estimate, truth = read_trajectory(run.folder / "trajectory.txt"), _truth(run)
        paths.append(_path(name, estimate.poses[:, :3, 3], colors[name]))
        pairs = associate(estimate.stamps_ns, truth.stamps_ns) if truth is not None else np.zeros((0, 2), np.int64)
        if truth is None or len(pairs) < 3:
            continue
        poses, expected = estimate.poses[pairs[:, 0]], truth.poses[pairs[:, 1]]
        if len(paths) == 1:
            T_world_truth = umeyama(expected[:, :3, 3], poses[:, :3, 3])
            paths.append(_path("ground truth", transform(T_world_truth, expected[:, :3, 3]), "black", dash="dash"))
        seconds = (estimate.stamps_ns[pairs[:, 0]] - estimate.stamps_ns[0]) / 1e9
        y = (1e3 * aligned_errors(poses, expected)).round(3).tolist()
        errors.append({"type": "scatter", "name": name, "x": seconds.tolist(), "y": y, "line": {"color": colors[name], "width": 1.5}})
    return paths, errors


def _truth(run: Run) -> Trajectory | None:
    recording = Recording(run.folder / "run.mcap")
    return attached_truth(recording.attachments, str(recording.path))


def _path(name: str, positions: Any, color: str, dash: str = "solid") -> dict[str, Any]:
    x, y, z = np.round(positions, 4).T.tolist()
    return {"type": "scatter3d", "mode": "lines", "name": name, "x": x, "y": y, "z": z, "line": {"width": 5, "dash": dash, "color": color}}


def _scene(up: F64) -> dict[str, Any]:
    """Seen from behind and above the first camera, which looks along z with x to its right."""
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    eye = EYE[0] * np.cross(ahead, up) + EYE[1] * up + EYE[2] * ahead
    camera = {"up": dict(zip("xyz", up.tolist())), "eye": dict(zip("xyz", eye.tolist())), "projection": {"type": "perspective"}}
    axis = {"showbackground": False, "title": {"text": ""}, "showspikes": False}
    return {"aspectmode": "data", "camera": camera, **{f"{name}axis": axis for name in "xyz"}}


def _surface(runs: dict[str, Run]) -> tuple[list[dict[str, Any]], F64]:
    """The mesh of the first run that has one, thinned where it is large, and which way is up."""
    up = np.array([0.0, -1.0, 0.0])  # of a camera held upright
    recording = next((found for run in runs.values() if "surface" in (found := Recording(run.folder / "run.mcap")).topics), None)
    if recording is None:
        return [], up
    surface = surface_of(recording)
    triangles = surface.triangles[:: max(1, -(-len(surface.triangles) // MOST_TRIANGLES))]
    (x, y, z), (i, j, k) = np.round(surface.vertices_m, 3).T.tolist(), triangles.T.tolist()
    colors = [f"rgb({r},{g},{b})" for r, g, b in surface.colors.tolist()]
    mesh = {"type": "mesh3d", "name": "surface", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "vertexcolor": colors, "opacity": 0.7}
    flat = {"lighting": {"ambient": 0.9, "diffuse": 0.2, "specular": 0.0}, "hoverinfo": "skip", "showlegend": False}
    return [mesh | flat], surface.up.astype(np.float64) if np.isfinite(surface.up).all() else up


def _buildings(runs: dict[str, Run]) -> dict[str, Building]:
    """The recorded building of each run that has one."""
    found = {}
    for name, run in runs.items():
        recording = Recording(run.folder / "run.mcap")
        for value in recording.values("building") if "building" in recording.topics else ():
            if isinstance(value, Building):
                found[name] = value
    return found


def _model(runs: dict[str, Run]) -> list[dict[str, Any]]:
    """The model of the first run's building, without its ceilings: a layer that is hidden until its name in the legend is clicked."""
    building = next(iter(_buildings(runs).values()), None)
    if building is None:
        return []
    traces = []
    for number, solid in enumerate(drawing_of(building).solids):
        (x, y, z), (i, j, k) = np.round(solid.vertices_m, 3).T.tolist(), solid.triangles.T.tolist()
        red, green, blue, opacity = solid.rgba
        look = {"color": f"rgb({red},{green},{blue})", "opacity": opacity / 255.0, "flatshading": True, "hoverinfo": "skip"}
        group = {"name": "building", "legendgroup": "building", "showlegend": number == 0, "visible": "legendonly"}
        traces.append({"type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, **look, **group})
    return traces


def _plans(runs: dict[str, Run]) -> list[str]:
    """The floor plan of each run that has a building."""
    parts = []
    for name, building in list(_buildings(runs).items())[:MOST_PICTURES]:
        data = base64.b64encode(floorplan_svg(building).encode()).decode()
        image = f"<img src='data:image/svg+xml;base64,{data}' alt='floor plan' style='width:auto;max-width:100%'>"
        parts.append(f"<figure><figcaption>{html.escape(name)}: {html.escape(summary(building))}</figcaption>{image}</figure>")
    return ["<h2>Floor plans</h2>", *parts] if parts else []


def _stages(runs: dict[str, Run], colors: dict[str, str]) -> list[dict[str, Any]]:
    traces = []
    for name, run in runs.items():
        stages = read_results(run.folder / "timing.json").get("stages") or {}
        shown = {stage: found["p50_ms"] for stage, found in stages.items() if found and "p50_ms" in found}
        traces.append({"type": "bar", "name": name, "x": list(shown), "y": list(shown.values()), "marker": {"color": colors[name]}})
    return traces


def _configurations(runs: dict[str, Run]) -> str:
    """Every value of the composed configurations that is not the same in all runs; an option that a run's plugin does not have is a dash."""
    flat = {name: flatten_dict(_config(run)) for name, run in runs.items()}
    keys = sorted({key for values in flat.values() for key in values})
    differing = [key for key in keys if len({repr(values.get(key)) for values in flat.values()}) > 1 and key != "out"]
    if not differing:
        return "<p>All the same.</p>"
    lines = ["<th></th>" + "".join(f"<th>{html.escape(name)}</th>" for name in flat)]
    for key in differing:
        lines.append(f"<td>{html.escape(key)}</td>" + "".join(f"<td>{html.escape(str(values.get(key, '-')))}</td>" for values in flat.values()))
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def _config(run: Run) -> Any:

    file = run.folder / ".hydra" / "config.yaml"
    try:
        found = parse_yaml(read_text(file, MAX_YAML_BYTES))
    except YamlError as error:
        raise DataError(str(file), f"is a text {error}", "run it again, or leave this folder out") from error
    return found if isinstance(found, dict) else {}


def _pictures(runs: dict[str, Run]) -> list[str]:
    """The middle frame of each run, as `trihedron picture` draws it."""
    import tempfile

    from trihedron.comparison.pictures import draw

    parts = []
    with tempfile.TemporaryDirectory() as folder:
        for name, run in list(runs.items())[:MOST_PICTURES]:
            file = Path(folder) / "picture.png"
            try:
                draw(str(run.folder / "run.mcap"), -1, file)
            except TrihedronError as error:
                parts.append(f"<p>{html.escape(str(error))}</p>")
                continue
            data = base64.b64encode(file.read_bytes()).decode()
            parts.append(f"<figure><figcaption>{html.escape(name)}</figcaption><img src='data:image/png;base64,{data}'></figure>")
    return parts
