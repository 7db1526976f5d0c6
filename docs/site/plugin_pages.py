"""Write the pages of the plugins from their docstrings, their options, the measured figures of docs/results and what they find in one frame."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.config import default_plugins
from trihedron.pipeline.core.registry import plugins_of
from trihedron.pipeline.core.slots import SLOTS, summary
from trihedron.tools.plugins import describe_plugin

FOLDER = "reference/plugins"  # below docs/
RESULTS = Path(__file__).resolve().parents[1] / "results" / "methods.json"
WITHOUT = {"pose": "refinement"}  # slot -> its name as in without=NAME, where that differs
MEASURED_WITH = {"surface": "surface outputs=[trajectory,surface]", "building": "building outputs=[trajectory,building]", "model": "model pose=icp"}
SIZE = {"width": 320, "height": 240, "length": 3}  # of the frame that figures show, its last
QUALITY = 82  # of JPEG
NEES_SCALE = "NEES is 5.35 where covariances are right"
HEAD = """# Plugins

`trihedron plugins` prints each one's options, defaults and source; `trihedron check SLOT PLUGIN` checks one, ours or yours. Figures were measured by
`make results PART=methods`, which runs `trihedron run -m experiment=methods` ([columns](../how-to/compare-plugins.md)) and, in
[a checkout](../how-to/install.md#benchmarks), `trihedron benchmark detectors`. Pictures show a frame of the synthetic room.
"""
Results = dict[str, Any]


def pages() -> dict[str, str | bytes]:
    """Text of each page, and its figure as a JPEG file, by its place below docs/."""
    results = json.loads(RESULTS.read_text())
    written: dict[str, str | bytes] = {f"{FOLDER}.md": overview()}
    for slot, name in built_in():
        figure = draw(slot, name) if slot in DRAWN else None
        written[f"{FOLDER}/{slot}/{name}.md"] = page(slot, name, results, figure is not None)
        if figure is not None:
            written[f"{FOLDER}/{slot}/{name}.jpg"] = figure
    return written


def built_in() -> list[tuple[str, str]]:
    """Slot and name of each plugin of this package."""
    return [(slot, name) for slot in SLOTS for name, kind in plugins_of(slot).items() if kind.__module__.startswith("trihedron.")]


def source_of(slot: str, name: str) -> str:
    """The file of a plugin, from the top of the repository."""
    return Path(*plugins_of(slot)[name].__module__.split(".")[1:]).with_suffix(".py").as_posix()


def overview() -> str:
    """The table of the plugins of this package, those of the default graph first and in bold."""
    names: dict[str, list[str]] = {slot: [] for slot in SLOTS}
    for slot, name in built_in():
        link = f"[`{name}`](plugins/{slot}/{name}.md)"
        names[slot] = [f"**{link}**", *names[slot]] if default_plugins().get(slot) == name else [*names[slot], link]
    rows = [(f"`{slot}`", ", ".join(links), summary(slot).rstrip(".")) for slot, links in names.items()]
    return HEAD + "\n" + markdown(["slot", "plugins (**default**)", "gives"], rows) + "\n"


def page(slot: str, name: str, results: Results, figure: bool) -> str:
    """The page of a plugin."""
    kind = plugins_of(slot)[name]
    described = describe_plugin(slot, name, kind)
    default = "The default. " if default_plugins().get(slot) == name else ""
    parts = [
        f"# `{slot}={name}`",
        inspect.cleandoc(kind.__doc__ or ""),
        f"{default}Inputs: {', '.join(f'`{one}`' for one in described['inputs']) or 'none'}. "
        f"[Source](../../../../{source_of(slot, name)}) · [all plugins](../../plugins.md)",
    ]
    parts += [f"![{slot}={name} on a frame of the synthetic room]({name}.jpg)"] if figure else []
    parts += ["## Options", _options(described["parameters"])] if described["parameters"] else []
    own, without = f"{_runs(slot, name, results)}\n\n{_detection_figures(slot, name, results)}".strip(), _without(slot, results)
    instead = "" if own or name == "none" else how_to_measure(slot, name)
    origin = f"*{source_line(results)}*" if own or without else ""
    measured = [part for part in (own, instead, without, origin) if part]
    return "\n\n".join([*parts, *(["## Measured", *measured] if measured else [])]) + "\n"


def how_to_measure(slot: str, name: str) -> str:
    """The command that gives the figures of a plugin that the file has none of."""
    if slot == "dataset":
        return "A data set has no figures. `trihedron benchmark FOLDER` measures a run on the data in a folder."
    if "model" in plugins_of(slot)[name].__dataclass_fields__:
        command = f"trihedron run {slot}={name} {slot}.model=FILE.onnx"
        return f"Needs a network in a file, and has no figures here. `{command}` and `trihedron compare` give them."
    if slot in MEASURED_WITH:
        words = f"'alternatives=[\"{MEASURED_WITH[slot]}\"]'"
        return f"Not among the figures yet. `trihedron run -m experiment=methods {words} out=runs/{slot}` measures all plugins of the slot."
    return f"Not among the figures yet. `trihedron ablate RUN.mcap {slot}={name} out=runs/{slot}` measures it on a recording."


def source_line(results: Results) -> str:
    """State the command, commit, date, versions and machine of the figures of a file, and its note on them."""
    if "commit" not in results:
        return "The figures state no commit."
    packages = ", ".join(f"{name} {number}" for name, number in results["packages"].items())
    machine = ", ".join(str(part) for part in (results["processor"], f"{results['cpus']} cores" if results["cpus"] else None) if part)
    python = f", Python {results['python']}" if results["python"] else ""
    note = f" {results['note'][0].upper()}{results['note'][1:]}." if results.get("note") else ""
    return f"Measured on commit `{results['commit']}` ({results['date']}) with `{results['command']}`: {packages}{python}; {machine}.{note}"


def _options(parameters: list[dict[str, Any]]) -> str:
    rows = [(f"`{p['name']}`", f"`{json.dumps(p['default'])}`", p["range"], p["doc"]) for p in parameters]
    return markdown(["option", "default", "range", ""], rows)


def _runs(slot: str, name: str, results: Results) -> str:
    """Figures of the default graph with this plugin, beside those of the default one."""
    runs = {(row["change"].partition(" ")[0], row["sequence"]): row for row in results["runs"]}
    change = next((row["change"] for row in results["runs"] if row["change"].partition(" ")[0] == f"{slot}={name}"), f"{slot}={name}")
    default = default_plugins().get(slot)
    own = {key: None for row in results["runs"] if row["change"].startswith(f"{slot}=") for key in row.get("measures", {})}  # columns, in order
    rows = []
    for sequence in dict.fromkeys(row["sequence"] for row in results["runs"]):
        row, base = runs.get((f"{slot}={name}", sequence)), runs.get(("default", sequence))
        row = base if row is None and name == default else row
        if row is not None and base is not None:
            rows.append((sequence, *_figures(row), _number(base["ate_mm"], 1), *(_number(row.get("measures", {}).get(key), 2) for key in own)))
    header = ["sequence", "ATE mm", "tracked %", "NEES", "ms", "frame ms", "MB", "ATE mm of the default", *own]
    return f"In the default graph with `{change}` (`trihedron run -m experiment=methods`); {NEES_SCALE}:\n\n" + markdown(header, rows) if rows else ""


def _figures(row: dict[str, Any]) -> tuple[str, ...]:
    if row["note"]:
        return (row["note"], *[""] * 5)
    tracked = None if row["tracked"] is None else 100.0 * row["tracked"]
    digits = ((row["ate_mm"], 1), (tracked, 0), (row["nees"], 2), (row["ms"], 1), (row["frame_ms"], 1), (row["mb"], 0))
    return tuple(_number(value, places) for value, places in digits)


def _detection_figures(slot: str, name: str, results: Results) -> str:
    """Figures by the truth of rendered scenes."""
    scenes = results["detectors"].get(slot, {}).get(name, {})
    if not scenes or "note" in scenes:
        return str(scenes.get("note", ""))
    header = ["scene", *next(iter(scenes.values()))]
    rows = [(scene, *(f"{value:.3g}" for value in figures.values())) for scene, figures in scenes.items()]
    return "By the truth of rendered scenes (`trihedron benchmark detectors`):\n\n" + markdown(header, rows)


def _without(slot: str, results: Results) -> str:
    """Cost of leaving the stage out."""
    change = f"without={WITHOUT.get(slot, slot)}"
    base = {row["sequence"]: row for row in results["runs"] if row["change"] == "default"}
    runs = [row for row in results["runs"] if row["change"] == change]
    rows = [(row["sequence"], *_figures(row)[:3], _number(base.get(row["sequence"], {}).get("ate_mm"), 1)) for row in runs]
    header = ["sequence", "ATE mm", "tracked %", "NEES", "ATE mm with it"]
    return f"Without the stage (`{change}`); {NEES_SCALE}:\n\n" + markdown(header, rows) if rows else ""


def _number(value: float | None, places: int) -> str:
    return "-" if value is None else f"{value:.{places}f}"


def markdown(header: list[str], rows: Sequence[tuple[Any, ...]]) -> str:
    """A table; bars in cells are escaped."""
    lines = [header, ["---"] * len(header), *([str(cell).replace("|", r"\|") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# Figures: what a stage finds in one frame.


def draw(slot: str, name: str) -> bytes | None:
    """Draw what a plugin finds, as a JPEG file; None where it needs a file or a library that is not there."""
    import cv2

    from trihedron.pipeline.core.errors import TrihedronError
    from trihedron.tools.plugin_check import PluginCheck, room, values_of

    scene = room(tuple(f"dataset.{key}={value}" for key, value in SIZE.items()))
    try:
        value = values_of(PluginCheck(slot, name).plugin, slot, scene)[-1]
    except TrihedronError:
        return None
    if value is None:
        return None
    picture = DRAWN[slot](scene.values[-1]["dataset"].color.copy(), value)
    encoded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    return bytes(encoded)


def _colors(count: int) -> Any:
    rng = np.random.default_rng(7)
    return rng.integers(60, 256, (count + 1, 3)).astype(np.uint8)


def _normals(picture: Any, value: Any) -> Any:
    cells = np.where(np.isfinite(value.normals), 127.5 - 127.5 * value.normals, 0.0).astype(np.uint8)
    height, width = picture.shape[:2]
    return np.repeat(np.repeat(cells, value.stride, axis=0), value.stride, axis=1)[:height, :width]


def _planes(picture: Any, value: Any) -> Any:
    height, width = picture.shape[:2]
    labels = np.repeat(np.repeat(value.labels, value.stride, axis=0), value.stride, axis=1)[:height, :width]
    tinted = (0.4 * picture + 0.6 * _colors(len(value.coefficients))[labels]).astype(np.uint8)
    return np.where(labels[..., None] > 0, tinted, picture)


def _keypoints(picture: Any, value: Any) -> Any:
    import cv2

    for (x, y), sigma in zip(value.pixels, value.sigma_px):
        cv2.circle(picture, (round(float(x)), round(float(y))), max(2, round(3.0 * float(sigma))), (60, 230, 60), 1, cv2.LINE_AA)
    return picture


def _lines(picture: Any, value: Any) -> Any:
    import cv2

    for (start, end), color in zip(np.rint(value.endpoints_px).astype(int), _colors(len(value.endpoints_px))):
        cv2.line(picture, tuple(map(int, start)), tuple(map(int, end)), tuple(map(int, color)), 2, cv2.LINE_AA)
    return picture


DRAWN: dict[str, Callable[[Any, Any], Any]] = {"normals": _normals, "keypoints": _keypoints, "lines": _lines, "segments": _lines, "planes": _planes}
