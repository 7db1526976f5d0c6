"""Measure the figures of the pages, and write docs/results/PART.json with the commit, versions, processor, date and command. `make results` runs it.

    python docs/results/measure.py sequences FOLDER KIND:FOLDER ...     # every run of the default graph in a process of its own
    python docs/results/measure.py honesty FOLDER KIND:FOLDER ...       # `trihedron benchmark honesty` over these, sensors and faults
    python docs/results/measure.py methods FOLDER KIND:FOLDER ...       # experiment=methods, over these too, and detectors by rendered scenes

What is measured already by the same commit is not measured again, so that a command that was stopped goes on. Figures of some code are those of its
commit: the measured folders may hold no change that is not committed.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from argparse import ArgumentParser
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import yaml

from trihedron.pipeline.core.errors import DataError, TrihedronError
from trihedron.pipeline.run.results import TIMING
from trihedron.pipeline.sweep.sweep import words_of_sequence
from trihedron.tools.benchmark import PROGRAM, machine, measure, reference_ms, sample_images
from trihedron.tools.benchmarks.honesty import sequence_text

ROOT = Path(__file__).resolve().parents[2]
RESULTS, WORK = ROOT / "docs" / "results", ROOT / "runs" / "results"
MEASURED = ("pipeline", "plugins", "datasets", "conf", "src")  # folders whose code decides on figures
ROOM = "synthetic length=150"
EXPERIMENT = ROOT / "conf" / "experiment" / "methods.yaml"
TRACKING = (
    "alternatives=planes,manhattan,tracks,rotation,translation,matches,pose"  # on recorded sequences: slots of tracking, whose plugins differ there
)
Row = dict[str, Any]


def main(argv: Sequence[str]) -> int:
    """Measure one part; returns the exit code."""
    parser = ArgumentParser(description=__doc__, prog="measure.py")
    parser.add_argument("part", choices=sorted(PARTS))
    parser.add_argument("data", nargs="*", help="folders of sequences, or KIND:FOLDER KEY=VALUE ... in quotes")
    options = parser.parse_args(argv)
    try:
        commit = commit_of(ROOT)
        WORK.mkdir(parents=True, exist_ok=True)
        file = RESULTS / f"{options.part}.json"
        write(file, {**header(options.part, commit), **PARTS[options.part](options.data, commit)})
    except TrihedronError as error:
        print(f"measure.py: {error}", file=sys.stderr)
        return 1
    print(f"{file.relative_to(ROOT)} is written")
    return 0


def commit_of(root: Path) -> str:
    """Return the last commit of the measured folders. Raises DataError where they hold other changes, or are in no repository."""
    changed = _git(root, "status", "--porcelain", "--", *MEASURED)
    if changed:
        raise DataError(changed.split()[1], "is changed and not committed: its figures would be those of no commit", "commit it, or stash it")
    return _git(root, "log", "-1", "--format=%H", "--", *MEASURED)[:12]


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)
    if done.returncode:
        raise DataError(str(root), f"is no git checkout ({done.stderr.strip()})", "measure in a clone of the repository")
    return done.stdout.strip()


def header(part: str, commit: str) -> Row:
    """Return what tells under which conditions the figures of a part are measured."""
    found = machine()
    return {
        "part": part, "command": f"make results PART={part}",
        "commit": commit, "date": datetime.now(timezone.utc).date().isoformat(),
        "processor": found["cpu"], "cpus": found["cpus"],
        "python": found["python"], "packages": found["packages"],
    }  # fmt: skip


def sequences(data: Sequence[str], commit: str) -> Row:
    """Run the default graph over the built-in room and each sequence. Rows that this commit has measured are read from runs/results."""
    rows = []
    for text in [ROOM, *map(sequence_text, data)]:
        words = words_of_sequence(text)
        name = next((Path(word.partition("=")[2]).name for word in words if word.startswith("dataset.path=")), text)
        file = WORK / f"{name.replace(' ', '_')}.json"
        known = json.loads(file.read_text()) if file.exists() else {}
        if (known.get("commit"), known.get("words")) != (commit, words):
            print(f"{name} ...", flush=True)
            known = {"commit": commit, "words": words, "row": {"sequence": name, **figures_of(words, WORK / "run")}}
            write(file, known)
        rows.append(known["row"])
    return {"minutes": round(sum(row["seconds"] for row in rows) / 60.0, 1), "sequences": rows}


def figures_of(words: Sequence[str], out: Path) -> Row:
    """Run the default graph in a process of its own, and return its figures: metres, degrees, milliseconds, MB (10⁶ bytes), seconds. Errors are None
    without ground truth. `reference_ms` is the reference workload of `trihedron benchmark`, before and after. Raises TrihedronError."""
    began, images = time.perf_counter(), sample_images(list(words))
    before = reference_ms(images)
    figures = measure([*words, f"out={out}"], out)
    reference = statistics.mean((before, reference_ms(images)))
    metrics, timing = figures["metrics"], json.loads((out / TIMING).read_text())
    final, status, honest = metrics.get("final", {}), metrics["status"], metrics.get("consistency") or {}
    frames = metrics["frames"]
    return {
        "frames": frames,
        **{name: status.get(name, 0) for name in ("ok", "degraded", "lost")},
        **{name: final.get(name) for name in ("ate_rmse_m", "rpe_second_rmse_m", "rpe_second_rmse_deg")},
        **{name: honest.get(name) for name in ("nees_median", "nees_mean", "share_within_95", "truth_sigma_m", "truth_sigma_deg")},
        "p50_ms": timing["frame_ms"]["p50"], "p95_ms": timing["frame_ms"]["p95"], "fps": timing["fps"],
        "reference_ms": round(reference, 1), "cpu_ms": round(1e3 * timing["cpu_s"] / max(timing["frames"], 1), 1),
        "peak_memory_mb": timing["peak_memory_mb"], "own_memory_mb": timing["own_memory_mb"],
        "seconds": round(time.perf_counter() - began, 1),
    }  # fmt: skip


def methods(data: Sequence[str], commit: str) -> Row:
    """Run experiment=methods over its own sequences and these, and the detectors. What this commit has measured is kept in a folder of its name."""
    folder = WORK / commit
    folder.mkdir(exist_ok=True)
    out, detectors, runs = folder / "methods", folder / "detectors.json", folder / "methods.json"
    began = time.perf_counter()
    _program("run", "-m", "experiment=methods", f"out={out}", f"sequences=[{','.join(map(json.dumps, sequences_of_methods(data)))}]")
    if not detectors.exists():
        _program("benchmark", "detectors", "--json", str(detectors))
    _program("benchmark", "methods", str(out), "--detectors", str(detectors), "--json", str(runs))
    found: Row = json.loads(runs.read_text().replace(f"{ROOT}/", ""))
    return {"minutes": round((time.perf_counter() - began) / 60.0, 1), **found}


def sequences_of_methods(data: Sequence[str]) -> list[str]:
    """Return the sequences of experiment=methods, then the given ones, with the slots of tracking where a word names no alternatives. Raises
    DataError."""
    given = [text if "alternatives=" in text else f"{text} {TRACKING}" for text in map(sequence_text, data)]
    return [*yaml.safe_load(EXPERIMENT.read_text())["sequences"], *given]


def honesty(data: Sequence[str], commit: str) -> Row:
    """Judge sensors, faults and these sequences. What this commit has run is kept in a folder of its name."""
    folder = WORK / commit / "honesty"
    folder.mkdir(parents=True, exist_ok=True)
    file, began = folder / "honesty.json", time.perf_counter()
    file.unlink(missing_ok=True)
    _program("benchmark", "honesty", *map(sequence_text, data), "--runs", str(folder), "--json", str(file))
    if not file.exists():
        raise DataError("trihedron benchmark honesty", "did not end", "mend what it names, and run it again: what is done is kept")
    found: Row = json.loads(file.read_text())
    return {"minutes": round((time.perf_counter() - began) / 60.0, 1), **found}


def _program(*words: str) -> None:
    done = subprocess.run([*PROGRAM, *words])
    if done.returncode not in (0, 1):  # 1: some jobs failed, which the table names
        raise DataError("trihedron " + " ".join(words[:2]), f"ended with {done.returncode}", "run it again: what is done is kept")


def write(file: Path, found: Row) -> None:
    """Write JSON with a row a line, whole or not at all."""
    lines = [f"{json.dumps(key)}: {_lines(value)}" for key, value in found.items()]
    part = file.with_suffix(".part")
    part.write_text("{" + ",\n".join(lines) + "}\n")
    part.replace(file)


def _lines(value: Any) -> str:
    """JSON of a value; a list of objects has a line for each."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(json.dumps(row, ensure_ascii=False) for row in value) + "\n]"
    return json.dumps(value, ensure_ascii=False)


PARTS = {"sequences": sequences, "honesty": honesty, "methods": methods}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
