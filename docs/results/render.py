"""Write the figures of docs/results/*.json into the pages: into each block between `<!-- results: NAME -->` and `<!-- end of results -->`.

    python docs/results/render.py

Under each table stand the command, commit and date of its figures.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "site"))
from plugin_pages import markdown, source_line

from trihedron.tools.benchmarks.judged_runs import FAULT, HEADER, alarm_cells, cells_of, rank_sentence
from trihedron.tools.method_tables import cell_of
from trihedron.tools.published import peer_figures, peers, published_ate_m, sequence_of

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
PAGES = ("README.md", "docs/explanation/results.md", "docs/explanation/uncertainty.md")
BLOCK = re.compile(r"(<!-- results: (?P<name>\w+) -->\n)(?P<text>.*?)(<!-- end of results -->)", re.DOTALL)
TITLES = {  # of sequences, by the names of their folders
    "synthetic length=150": "built-in room, 150 frames",
    "tum_fr3_structure_notexture_far": "TUM structure_notexture_far, first 8.6 s",
    "icl_nuim_of_kt3": "ICL-NUIM office kt3, first 59 images",
    "icl_office_rendered": "ICL office rendered",
    "hololens_walk": "HoloLens walk",
    "seven_scenes_kitchen": "7-Scenes kitchen, frames 400–559",
    "d435_desk": "D435 at a desk (no truth)",
}
PROGRAMS = ("ORB-SLAM2", "ManhattanSLAM", "PlanarSLAM")
FINE_M = 0.02  # errors below have four digits, others three
PLACES_OF_METHODS = 3  # sequences that the table of methods shows: all plugins ran on them
Row = dict[str, Any]


def main() -> int:
    """Write all blocks; returns the exit code."""
    for name in PAGES:
        path = ROOT / name
        path.write_text(render_page(path.read_text()))
    return 0


def render_page(page: str) -> str:
    """Return a page with its blocks as the files of results give them."""
    return BLOCK.sub(lambda match: f"{match[1]}{BLOCKS[match['name']]()}\n{match[4]}", page)


def read(part: str) -> Row:
    """Return the figures of a part."""
    found: Row = json.loads((RESULTS / f"{part}.json").read_text())
    return found


def sequence_rows() -> tuple[Row, list[Row]]:
    """Return the part `sequences` and its rows, in the order of TITLES."""
    found, order = read("sequences"), list(TITLES)
    return found, sorted(found["sequences"], key=lambda row: order.index(row["sequence"]))


def accuracy() -> str:
    """The error of each sequence beside that of other programs on the same frames."""
    found, rows = sequence_rows()
    lines = []
    for row in rows:
        if row["ate_rmse_m"] is not None and not row["sequence"].startswith("synthetic"):
            lines.append((TITLES[row["sequence"]], row["frames"], _ate(row), *_peers(row), _nees(row)))
    header = ["ATE RMSE, m", "frames", "Trihedron", *PROGRAMS, "NEES"]
    return f"{markdown(header, lines)}\n\n*{source_line(found)} Other programs: {peers()['source']}; two figures are two runs.*\n"


def sequences() -> str:
    """Errors, times and memory of the default graph on each sequence."""
    found, rows = sequence_rows()
    header = ["sequence", "ok / degraded / lost", "ATE, mm", "RPE over 1 s"]
    header += ["frames/s", "p50, p95 ms", "× reference", "CPU ms a frame", "own MB", "peak MB"]
    lines = []
    for row in rows:
        rpe = "–" if row["rpe_second_rmse_m"] is None else f"{1e3 * row['rpe_second_rmse_m']:.1f} mm {row['rpe_second_rmse_deg']:.3f}°"
        speed = (_text(row["fps"], 1), f"{row['p50_ms']:.1f}, {row['p95_ms']:.1f}", _text(row["p50_ms"] / row["reference_ms"], 1))
        memory = (_text(row["cpu_ms"], 1), _text(row["own_memory_mb"], 0), _text(row["peak_memory_mb"], 0))
        lines.append((TITLES[row["sequence"]], _status(row), _text(row["ate_rmse_m"], 2, 1e3), rpe, *speed, *memory))
    return f"{markdown(header, lines)}\n\n*{source_line(found)}*\n"


def durations() -> str:
    """How long measuring takes."""
    found = read("sequences")
    taken = f"`make results PART=sequences` took {found['minutes']} minutes on {found['cpus']} cores"
    return f"{taken}; [the other part](../how-to/compare-plugins.md#conditions) is estimated from shorter runs.\n"


def other_programs() -> str:
    """Errors beside those of other programs and of the paper."""
    found, rows = sequence_rows()
    lines = []
    for row in rows:
        if row["sequence"].startswith("synthetic") or row["ate_rmse_m"] is None:
            continue
        title, paper = TITLES[row["sequence"]], published_ate_m(sequence_of(row["sequence"]) or "", "structural_paper")
        lines.append((f"{title}, ATE m", f"**{_ate(row)}**", *_peers(row), "–" if paper is None else paper))
        if any("rpe_second_m" in figures for figures in peer_figures(row["sequence"], row["frames"]).values()):
            own = _rpe(row["rpe_second_rmse_m"], row["rpe_second_rmse_deg"])
            lines.append((f"{title}, RPE over 1 s", f"**{own}**", *_peer_rpe(row), "–"))
    return f"{markdown(['', 'ours', *PROGRAMS, 'paper (whole)'], lines)}\n\n*{source_line(found)}*\n"


def consistency() -> str:
    """Status and NEES of the poses of each sequence."""
    found, rows = sequence_rows()
    header = ["sequence", "frames ok / degraded / lost", "ATE, mm", "NEES, median", "inside 95 %", "truth's noise counted in"]
    lines = []
    for row in rows:
        noise = f"{1e3 * row['truth_sigma_m']:.1f} mm, {row['truth_sigma_deg']:.2f}°" if row["truth_sigma_m"] or row["truth_sigma_deg"] else "–"
        within = _text(row["share_within_95"], 0, 100.0) + (" %" if row["share_within_95"] is not None else "")
        lines.append((TITLES[row["sequence"]], _status(row), _text(row["ate_rmse_m"], 2, 1e3), _nees(row), within, noise))
    return f"{markdown(header, lines)}\n\n*{source_line(found)}*\n"


def methods() -> str:
    """Each plugin in the default graph in rooms: ATE in mm by sequence, and medians of NEES and of the stage's time."""
    found = read("methods")
    return _table_of_methods(found, _without_repeats(row["sequence"] for row in found["runs"])[:PLACES_OF_METHODS])


def methods_recorded() -> str:
    """Each plugin of the slots of tracking in the default graph on the recorded sequences with truth, likewise."""
    found = read("methods")
    known = {row["sequence"] for row in found["runs"] if row["ate_mm"] is not None}
    return _table_of_methods(found, [place for place in TITLES if place in known])


def _table_of_methods(found: Row, places: Sequence[str]) -> str:
    changes = _without_repeats(row["change"] for row in found["runs"] if row["sequence"] in places)
    lines = []
    for change in changes:
        if change.startswith(("graph=", "without=")):
            continue
        rows = {row["sequence"]: row for row in found["runs"] if row["change"] == change and row["sequence"] in places}
        key = "frame_ms" if change == "default" else "ms"
        name = "default (whole frame)" if change == "default" else f"`{change}`"
        lines.append((name, *(cell_of(rows.get(place)) for place in places), _median(rows.values(), "nees", 2), _median(rows.values(), key, 1)))
    header = ["change", *(TITLES.get(place, place) for place in places), "NEES", "ms"]
    return f"{markdown(header, lines)}\n\n*{source_line(found)}*\n"


def libraries() -> str:
    """The default graph and that of libraries alone, on each sequence that both have tracked: ATE in mm."""
    found = read("methods")
    changes = ("default", "graph=libraries")
    cells = {(row["change"], row["sequence"]): cell_of(row) for row in found["runs"] if row["change"] in changes}
    places = _without_repeats(place for change, place in cells if change != "default")
    lines = [(f"`{change}`", *(cells.get((change, place), "") for place in places)) for change in changes]
    return f"{markdown(['graph', *places], lines)}\n\n*{source_line(found)}*\n"


def detectors() -> str:
    """Detectors by the truth of the synthetic room."""
    found, parts = read("methods"), []
    for slot, plugins in found["detectors"].items():
        rooms = {name: scenes["room"] for name, scenes in plugins.items() if "room" in scenes}
        columns = list(next(iter(rooms.values())))
        lines = [(f"`{name}`", *(f"{room[column]:.3g}" for column in columns)) for name, room in rooms.items()]
        parts.append(markdown([slot, *columns], lines))
    return "\n\n".join(parts) + f"\n\n*{source_line({**found, 'command': 'trihedron benchmark detectors'})}*\n"


def honesty_sensors() -> str:
    """Honesty of clean runs: by sensor, room and sequence, and over all; and their false alarms by the test."""
    found = read("honesty")
    rows = [cells_of({**row, "name": TITLES.get(row["name"], row["name"])}) for row in found["rows"] if row["kind"] != FAULT]
    alarms = markdown(["false alarm", "frames", "% of a run"], [tuple(alarm_cells(row)) for row in found["alarms"]])
    none = "No frame of a clean run is less than `ok`."
    rank = f"\n\n{rank_sentence(found['rank'])}" if found.get("rank") else ""
    return f"{markdown(HEADER, [tuple(row) for row in rows])}\n\n{alarms if found['alarms'] else none}{rank}\n\n*{source_line(found)}*\n"


def honesty_faults() -> str:
    """Honesty under degenerate input, and the tests that tell it."""
    found = read("honesty")
    rows = [row for row in found["rows"] if row["kind"] == FAULT]
    lines = [(f"`{row['name']}`", *cells_of(row)[3:], _tests(row["not_ok"])) for row in rows]
    wrong = [f"`{row['name']}` ({row['wrong_ok']})" for row in rows if row["wrong_ok"]]
    sentence = f"Cases with wrong `ok` frames: {', '.join(wrong)}." if wrong else "No case has a wrong `ok` frame."
    return f"{markdown(['case', *HEADER[3:], 'frames not ok, by the test'], lines)}\n\n{sentence}\n\n*{source_line(found)}*\n"


def _tests(counts: Row) -> str:
    return ", ".join(f"{test} ({frames})" for test, frames in counts.items()) or "–"


OF_SEQUENCES = (accuracy, sequences, durations, other_programs, consistency)
OF_HONESTY, OF_METHODS = (honesty_sensors, honesty_faults), (methods, methods_recorded, libraries, detectors)
BLOCKS: dict[str, Callable[[], str]] = {one.__name__: one for one in (*OF_SEQUENCES, *OF_HONESTY, *OF_METHODS)}


def _without_repeats(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _status(row: Row) -> str:
    return f"{row['ok']} / {row['degraded']} / {row['lost']}"


def _ate(row: Row) -> str:
    return _metres(row["ate_rmse_m"])


def _metres(value: float) -> str:
    return f"{value:.4f}" if value < FINE_M else f"{value:.3f}"


def _nees(row: Row) -> str:
    return _text(row["nees_median"], 1 if (row["nees_median"] or 0.0) < 100.0 else 0)


def _peers(row: Row) -> list[str]:
    """ATE of each other program in m, or why there is none."""
    found = peer_figures(row["sequence"], row["frames"])
    return [_peer(found.get(program, {})) for program in PROGRAMS]


def _peer(figures: Row) -> str:
    errors = "–".join(map(_metres, figures.get("ate_m", ())))
    return " ".join(text for text in (errors, f"({figures['note']})" if errors and "note" in figures else figures.get("note", "")) if text) or "–"


def _peer_rpe(row: Row) -> list[str]:
    found = [peer_figures(row["sequence"], row["frames"]).get(program, {}) for program in PROGRAMS]
    return [_rpe(figures.get("rpe_second_m"), figures.get("rpe_second_deg")) for figures in found]


def _rpe(metres: float | None, degrees: float | None) -> str:
    return "–" if metres is None or degrees is None else f"{metres:.4f} m {degrees:.3f}°"


def _median(rows: Iterable[Row], key: str, digits: int) -> str:
    values: Sequence[float] = [row[key] for row in rows if row[key] is not None]
    return _text(statistics.median(values), digits) if values else "–"


def _text(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:.{digits}f}"


if __name__ == "__main__":
    sys.exit(main())
