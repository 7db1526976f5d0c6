"""Judge runs by sensors of several kinds: errors, how honest the stated covariances are, and frames that are `ok` and wrong.

Each sensor records each room, with --seeds sensors of its kind (their hidden parameters, and the path through the room, differ by the seed). Columns:
ok, degraded and lost frames in percent, ATE of the posed frames (as estimated at the time, each sub-map aligned by itself), wrong ok: frames with
status ok that are off by more than 5 cm and 4 σ, or 2° and 4 σ, NEES (6 degrees of freedom; median, honest: 5.35), frames inside its 95 % limit, AUC
of "error above its median" by σ (over all frames of the row), mean log-likelihood of an error in nats, and steps within 50 mm. With --quality, runs
are judged without the truth, too (`trihedron evaluate RUN --no-reference`), and the rank correlation of each such figure with the ATE is printed.
--runs keeps the runs in a folder, and judges those that it holds already without running them again. Other words are overrides of `trihedron run`.

Example: trihedron benchmark sensors --sensors kinect_v1,phone --rooms room --seeds 1 --length 60
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser

if TYPE_CHECKING:
    from trihedron.pipeline.run.status_check import FrameErrors, StatusCheck

SENSORS = ("kinect_v1", "tof", "realsense_stereo", "hololens", "phone")
ROOMS = {  # name -> what the data set is given
    "room": (),
    "bare": ("dataset.texture=false",),
    "slanted": ("dataset.slanted=true", "dataset.curved=true"),
    "fast": ("dataset.motion=fast",),
    "offices": ("dataset.scene=offices",),
    "corridor": ("dataset.scene=corridor",),
    "flat": ("dataset.scene=flat",),
}
USUAL_ROOMS = "room,bare,fast,offices"
HEADER = ["sensor", "room", "runs", "ok %", "degr %", "lost %", "ATE mm", "wrong ok", "NEES", "in 95 %", "AUC", "log-lik", "steps %"]
COUNTS = ("frames", "posed", "parts")  # of a run judged without truth: no measures of its quality
Judged = tuple["StatusCheck", "FrameErrors"]


def main(argv: list[str]) -> int:
    """Print the table; returns 0. Raises UsageError for an unknown sensor or room, TrihedronError for a run that fails."""
    parser = Parser("benchmark sensors", __name__)
    parser.add_argument("--sensors", default=",".join(SENSORS), metavar="A,B", help=f"(default: {','.join(SENSORS)})")
    parser.add_argument("--rooms", default=USUAL_ROOMS, metavar="A,B", help=f"some of {', '.join(ROOMS)} (default: {USUAL_ROOMS})")
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="sensors of each kind (default: 2)")
    parser.add_argument("--length", type=int, default=120, metavar="N", help="frames of each run (default: 120)")
    parser.add_argument("--quality", action="store_true", help="judge the runs without truth, too")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="keep the runs here, and judge those that are there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of each run, with the hidden parameters")
    options, overrides = parser.parse_known_args(argv)
    if not (1 <= options.seeds <= 100 and 10 <= options.length <= 100_000):
        raise UsageError("benchmark sensors", "--seeds or --length is out of range", "give 1 to 100 seeds and 10 to 100000 frames")
    cases = [(s, r, seed) for s in chosen(options.sensors, SENSORS) for r in chosen(options.rooms, ROOMS) for seed in range(options.seeds)]
    for word in overrides:
        if "=" not in word:
            raise UsageError("benchmark sensors", f"'{word}' is not key=value", "see trihedron benchmark sensors --help")
    with tempfile.TemporaryDirectory() as temporary:
        folder: Path = options.runs or Path(temporary)
        found = []
        for sensor, room, seed in cases:
            run = folder / f"{sensor}-{room}-{seed}"
            judged = run_and_judge(run, [*words_of(sensor, room, seed, options.length), *overrides])
            found.append({"sensor": sensor, "room": room, "seed": seed, "judged": judged, "quality": _quality(run) if options.quality else {}})
            print("\r" + " ".join(_cells([sensor, room], [judged])), flush=True)
    print("\n" + report(found))
    if options.quality:
        print("\n" + correlations(found))
    if options.json:
        options.json.write_text(json.dumps([_plain(row) for row in found], indent=2) + "\n")
    return 0


def chosen(text: str, known: Iterable[str]) -> list[str]:
    """Split A,B. Raises UsageError for a name that is not known."""
    names = [name for name in text.split(",") if name]
    for name in names:
        if name not in known:
            raise UsageError("benchmark", f"there is no '{name}'", did_you_mean(name, list(known)))
    return names


def words_of(sensor: str, room: str, seed: int, length: int) -> list[str]:
    """Overrides of the run of a sensor in a room."""
    own = [f"dataset.sensor={sensor}", f"dataset.sensor_seed={seed}", f"dataset.seed={seed}", f"dataset.length={length}"]
    return ["dataset=simulated_sensor", *own, *ROOMS[room], "outputs=[trajectory]"]


def run_and_judge(run: Path, words: Sequence[str]) -> Judged:
    """Run unless the folder is there, and compare the poses with the truth."""
    from trihedron.tools.benchmark import measure

    if not (run / "timing.json").exists():
        measure([*words, f"out={run}"], run)
    return judged_run(run)


def judged_run(run: Path) -> Judged:
    """Compare the poses of a recorded run with the truth in it. Raises DataError where there is none."""
    from trihedron.pipeline.app.recorded_values import poses_of, references_of
    from trihedron.pipeline.record.reader import Recording
    from trihedron.pipeline.record.trajectories import attached_truth
    from trihedron.pipeline.run.status_check import check_status

    recording = Recording(run / "run.mcap")
    truth = attached_truth(recording.attachments, str(recording.path))
    if truth is None:
        raise DataError(str(recording.path), "holds no ground truth", "judge a run of a data set that has it")
    return check_status(poses_of(recording), truth, len(references_of(recording)))


def _quality(run: Path) -> dict[str, float]:
    from trihedron.tools.quality import quality_of_run

    return quality_of_run(run).to_dict()


def report(found: Sequence[dict[str, Any]]) -> str:
    """Make the table: a row for each sensor in each room, one for each sensor, one for all."""
    rows = [HEADER]
    sensors = list(dict.fromkeys(row["sensor"] for row in found))
    for sensor in sensors:
        own = [row for row in found if row["sensor"] == sensor]
        for room in dict.fromkeys(row["room"] for row in own):
            rows.append(_cells([sensor, room], [row["judged"] for row in own if row["room"] == room]))
        rows.append(_cells([sensor, "all"], [row["judged"] for row in own]))
    rows.append(_cells(["all", "all"], [row["judged"] for row in found]))
    return table(rows, "llrrrrrrrrrrr")


def _cells(names: list[str], judged: Sequence[Judged]) -> list[str]:
    """Fill a row: medians of ATE and NEES over runs, shares and sums over all frames."""
    from trihedron.pipeline.run.status_check import sigma_auc

    checks, errors = [check for check, _ in judged], [e for _, e in judged]
    frames = sum(check.frames for check in checks)

    def share(name: str) -> str:
        return f"{100 * sum(getattr(check, name) for check in checks) / max(frames, 1):.1f}"

    def median(name: str, factor: float, decimals: int) -> str:
        values = [getattr(check, name) for check in checks if getattr(check, name) is not None]
        return f"{factor * float(np.median(values)):.{decimals}f}" if values else "-"

    e, sigma = (np.concatenate([getattr(x, name)[x.judged] for x in errors]) for name in ("error_m", "sigma_m"))
    auc = sigma_auc(e, sigma)
    cells = [share("ok"), share("degraded"), share("lost"), median("ate_m", 1e3, 1), str(sum(check.wrong_ok for check in checks))]
    cells += [median("nees_median", 1.0, 1), median("share_within_95", 100.0, 0), "-" if auc is None else f"{auc:.2f}"]
    return [*names, str(len(judged)), *cells, median("log_likelihood", 1.0, 1), median("steps_within_50mm", 100.0, 1)]


def correlations(found: Sequence[dict[str, Any]]) -> str:
    """Make the table of Spearman's rank correlation of each figure without truth with the ATE over the runs."""
    from scipy.stats import spearmanr

    names = list(dict.fromkeys(name for row in found for name in row["quality"] if name not in COUNTS))
    rows = [["figure without truth", "rank correlation with ATE", "runs"]]
    for name in names:
        pairs = [(row["quality"].get(name), row["judged"][0].ate_m) for row in found]
        known = np.array([pair for pair in pairs if None not in pair and np.isfinite(pair).all()]).reshape(-1, 2)
        varies = len(known) > 2 and np.ptp(known, axis=0).min() > 0.0
        rho = f"{spearmanr(known[:, 0], known[:, 1])[0]:+.2f}" if varies else "-"
        rows.append([name, rho, str(len(known))])
    return table(rows, "lrr")


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """Turn the figures of one run into what JSON holds."""
    from trihedron.datasets.simulation.sensor_models import Sensor, drawn_parameters

    names = {name: row[name] for name in ("sensor", "room", "seed", "quality")}
    return {**names, **row["judged"][0].to_dict(), "hidden": drawn_parameters(Sensor[row["sensor"]], row["seed"]).to_dict()}
