"""Time a run per frame and stage, with its memory, beside a fixed reference workload of the same minute and frames.

The machine's speed varies, so times are also given as multiples of the reference: OpenCV ORB (1000 features, 8 levels) and LSD on the same frames,
one thread, measured before and after each run. --paced runs the frames a second time at the camera's own rate: latency is then from when a
frame is due, before its files are read, to its pose. --one-core plays the frames as a camera would on one core and one thread, which drops those that
come while it is busy. --cold runs one frame with an empty kernel cache. --compare lists what became slower since a --json file.

--peers runs ORB-SLAM3 on the same frames at the camera's rate, too, in an interpreter that has the package pyorbslam3 (GPL-3, no dependency of this
project), and prints both side by side. Its trajectories are judged by the same ground truth and code.

Other comparisons, each with its --help: `trihedron benchmark methods` (every plugin in the default graph) and `trihedron benchmark rotations`
(estimators of the Manhattan frame over one recording). The source checkout has more, which an installed package has not: `trihedron benchmark
manhattan` (these estimators on rendered rooms), `trihedron benchmark detectors` (all detectors, by the truth of rendered scenes), `trihedron
benchmark surface` (all surfaces, by the true one), `trihedron benchmark map` (drift, recovery and growth of the map), `trihedron benchmark long`
(what a long run leaves behind), `trihedron benchmark scaling` (threads, image size, features, length), `trihedron benchmark parts` (features and
matching beside OpenCV's), `trihedron benchmark recording` (what recording costs), `trihedron benchmark building`, `trihedron benchmark sensors`
and `trihedron benchmark faults` (how honest status and covariances are on simulated sensors of several kinds and under degenerate input), `trihedron
benchmark honesty` (both in one table, with recorded sequences).

`trihedron compare` makes a table of the runs of any sweep. Overrides are those of `trihedron run --help`, where data sets, graphs and the groups
`without=` and `experiment=` are listed; relative paths begin in the working folder, and nothing else is searched.

Example: trihedron benchmark FOLDER dataset.frames=0:150 --json benchmark.json
Example: trihedron benchmark FOLDER --peers --peer-python orbslam3/bin/python --vocabulary ORBvoc.txt
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.layouts import data_set_words
from trihedron.pipeline.core.types import U8
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmark_comparison import comparison_table, read_figures, times
from trihedron.tools.peers.side_by_side import find_peer, own_figures, peer_figures, side_by_side, write_job

PROGRAM = (sys.executable, "-m", "trihedron")
ON_CORE = "import os, runpy; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); runpy.run_module('trihedron', run_name='__main__')"  # Linux
ON_ONE_CORE = (sys.executable, "-c", ON_CORE)
REFERENCE_FRAMES = 40  # at most
OF_CHECKOUT = "trihedron.tools.benchmarks"  # which wheels lack
COMPARISONS = {  # other words after `benchmark`, and whose `main` they stand for
    "building": f"{OF_CHECKOUT}.building_benchmark",
    "detectors": f"{OF_CHECKOUT}.detector_truth",
    "faults": f"{OF_CHECKOUT}.fault_benchmark",
    "honesty": f"{OF_CHECKOUT}.honesty",
    "long": f"{OF_CHECKOUT}.long_run",
    "manhattan": f"{OF_CHECKOUT}.manhattan_family",
    "map": f"{OF_CHECKOUT}.map_benchmark",
    "methods": "trihedron.tools.method_tables",
    "parts": f"{OF_CHECKOUT}.part_times",
    "recording": f"{OF_CHECKOUT}.recording_benchmark",
    "rotations": "trihedron.tools.rotation_comparison",
    "scaling": f"{OF_CHECKOUT}.scaling_benchmark",
    "sensors": f"{OF_CHECKOUT}.sensor_benchmark",
    "surface": f"{OF_CHECKOUT}.surface_family",
}


def main(argv: list[str]) -> int:
    """Run `trihedron run` with the given overrides in a process of its own, then the reference; print a table and optionally write JSON.
    A word of COMPARISONS hands over to that."""
    if argv[:1] and argv[0] in COMPARISONS:
        return int(comparison(argv[0]).main(argv[1:]))
    parser = Parser("benchmark", __name__)
    parser.add_argument("overrides", nargs="*", help="as for trihedron run, or the folder of a data set")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    parser.add_argument("--compare", type=Path, metavar="OLD.json", help="say what became slower since then")
    parser.add_argument("--paced", action="store_true", help="a second run at the camera's own rate")
    parser.add_argument("--one-core", action="store_true", help="a run at the camera's own rate on one core, which may drop frames")
    parser.add_argument("--cold", action="store_true", help="time the first frame with an empty kernel cache, too (half a minute)")
    parser.add_argument("--peers", action="store_true", help="--paced, and ORB-SLAM3 on the same frames")
    parser.add_argument("--peer-python", metavar="PYTHON", help="with --peers: an interpreter that has pyorbslam3 (default: this one)")
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help="with --peers: ORBvoc.txt (default: that in the cache of pyorbslam3)")
    options, rest = parser.parse_known_args(argv)
    overrides = [override for word in (*options.overrides, *rest) for override in data_set_words(word)]
    _check_overrides(overrides)
    old = read_figures(options.compare) if options.compare else None
    peer = find_peer(options.peer_python or sys.executable, options.vocabulary) if options.peers else None
    if peer is None and (options.peer_python or options.vocabulary):
        raise UsageError("benchmark", f"{'--peer-python' if options.peer_python else '--vocabulary'} is of --peers", "give --peers too")
    with tempfile.TemporaryDirectory() as folder:
        images = sample_images(overrides)
        job = write_job(dataset_of(overrides), peer, Path(folder) / "peer") if peer is not None else None
        reference = [reference_ms(images)]
        figures = measure([*overrides, f"out={folder}/run"], Path(folder) / "run")
        reference.append(reference_ms(images))
        figures["cli_cpu_s"] = _cpu_of(["--help"])
        if options.paced or options.peers:
            paced = measure([*overrides, "real_time=true", f"out={folder}/paced"], Path(folder) / "paced")
            figures["paced"] = paced["frame_ms"]
            reference.append(reference_ms(images))
        if options.one_core:
            words = [*overrides, "live=true", "threads=1", f"out={folder}/one_core"]
            figures["one_core"] = measure(words, Path(folder) / "one_core", program=ON_ONE_CORE)
            reference.append(reference_ms(images))
        if peer is not None and job is not None:
            run = Path(folder) / "paced"
            figures["peers"] = {"trihedron": own_figures(figures, paced, run), "orbslam3": peer_figures(peer, job, run)}
            reference.append(reference_ms(images))
        figures["reference_ms"], figures["reference_each_ms"] = round(statistics.mean(reference), 2), reference
        if options.cold:
            figures["cold_first_frame_s"] = _cold(overrides, Path(folder))
    figures["machine"] = machine()
    print(report(figures))
    if old is not None:
        print("\n" + comparison_table(old, figures))
    if options.json:
        write_file(options.json, json.dumps(figures, indent=2) + "\n")
    return 0


def comparison(word: str) -> Any:
    """Return the module of a word of COMPARISONS. Raises UsageError where only the source checkout has it."""
    try:
        return importlib.import_module(COMPARISONS[word])
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith(OF_CHECKOUT):
            raise
        cure = "get the sources, and in their folder: pip install -e ."
        raise UsageError(f"benchmark {word}", "is in the source checkout, and not in the installed package", cure) from None


def _check_overrides(overrides: list[str]) -> None:
    """Raise UsageError for a word that is no override: it may be a comparison misspelt."""
    for word in overrides:
        if "=" not in word:
            raise UsageError("benchmark", f"'{word}' is neither key=value, a comparison nor an existing folder", did_you_mean(word, COMPARISONS))


def measure(overrides: list[str], out: Path, environment: dict[str, str] | None = None, program: Sequence[str] = PROGRAM) -> dict[str, Any]:
    """`timing.json` and metrics of one run in its own process. Raises TrihedronError when it fails.

    The peak of its memory is the one it has measured itself: what the system counts of a child begins with what its parent held."""
    from trihedron.pipeline.core.errors import StageError

    began = time.perf_counter()
    process = subprocess.Popen([*program, "run", *overrides], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr is not None
    errors = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status):
        last = errors.strip().splitlines()[-1].removeprefix("trihedron: ") if errors.strip() else "without a word"
        raise StageError("benchmark", f"the run failed: {last}", "mend that first")
    figures: dict[str, Any] = json.loads((out / "timing.json").read_text())
    figures["tracking_cpu_s"] = figures["cpu_s"]
    figures["cpu_s"] = round(usage.ru_utime + usage.ru_stime, 2)
    figures["process_s"] = round(time.perf_counter() - began, 2)
    if (out / "metrics.json").exists():
        figures["metrics"] = json.loads((out / "metrics.json").read_text())
    return figures


def memory_text(figures: dict[str, Any]) -> str:
    """The peak in MB (10⁶ bytes), or "?" where the system does not say."""
    peak = figures["peak_memory_mb"]
    return "?" if peak is None else f"{peak:.0f}"


def _cpu_of(words: list[str]) -> float:
    """Seconds of CPU of a command that prints and ends."""
    process = subprocess.Popen([*PROGRAM, *words], stdout=subprocess.DEVNULL)
    _, _, usage = os.wait4(process.pid, 0)
    return round(usage.ru_utime + usage.ru_stime, 2)


def _cold(overrides: list[str], folder: Path) -> float:
    """Seconds from the command to the end of a run of one frame that finds no compiled kernel."""
    words = [word for word in overrides if not word.startswith("dataset.frames=")]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kernels")}
    seconds: float = measure([*words, "dataset.frames=0:1", f"out={folder}/cold"], folder / "cold", environment)["process_s"]
    return seconds


def machine() -> dict[str, Any]:
    """Machine on which the figures were measured, and the versions."""
    cpuinfo = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    models = [line.partition(":")[2].strip() for line in cpuinfo.splitlines() if line.startswith("model name")]
    packages = {name: version(name) for name in ("trihedron", "numpy", "numba", "opencv-contrib-python-headless")}
    return {
        "system": platform.platform(), "cpu": models[0] if models else platform.processor(), "cpus": os.cpu_count(),
        "python": platform.python_version(), "packages": packages,
    }  # fmt: skip


def dataset_of(overrides: list[str]) -> Any:
    """Return the data set of a run."""
    from trihedron.pipeline.core.config import compose_run, make_plugin

    return make_plugin("dataset", compose_run(overrides).dataset)


def sample_images(overrides: list[str]) -> list[U8]:
    """Grey images (h, w) of frames spread over the run."""
    dataset = dataset_of(overrides)
    frames = [dataset(i) for i in range(0, len(dataset), max(-(-len(dataset) // REFERENCE_FRAMES), 1))]
    return [frame.gray for frame in frames if frame is not None]


def reference_ms(images: Sequence[U8]) -> float:
    """Median milliseconds of ORB + LSD on an image (h, w), one thread."""
    import cv2
    import numpy as np

    cv2.setNumThreads(1)
    orb, lsd, times = cv2.ORB_create(1000, 1.2, 8), cv2.createLineSegmentDetector(), []
    for image in images:
        began = time.perf_counter()
        orb.detectAndCompute(image, None)
        lsd.detect(image)
        times.append(1e3 * (time.perf_counter() - began))
    return round(float(np.median(times)), 2)


def report(figures: dict[str, Any]) -> str:
    """The figures as text."""
    reference, of = figures["reference_ms"], figures["machine"]
    per_frame = 1e3 / figures["fps"] if figures["fps"] else 0.0
    lines = [
        f"{of['cpu']}, {of['cpus']} CPUs, Python {of['python']}, " + ", ".join(f"{name} {number}" for name, number in of["packages"].items()),
        f"{figures['frames']} frames, {figures['threads']} threads, reference workload {reference:.1f} ms"
        f" ({', '.join(f'{ms:.1f}' for ms in figures['reference_each_ms'])} before and after each run)",
        f"{'':14} {'p50 ms':>8} {'p95 ms':>8} {'x reference':>12}",
    ]
    for name, (p50, p95) in times(figures).items():
        lines.append(f"{name:14} {p50:8.2f} {p95:8.2f} {p50 / reference:12.2f}")
    used = figures["cpu_s"] / figures["process_s"]
    lines += [
        f"throughput {figures['fps']:.1f} frames/s: {per_frame:.1f} ms a frame, {per_frame / reference:.2f} x reference",
        f"start-up {figures['startup_s']:.1f} s, --help {figures['cli_cpu_s']:.2f} s of CPU"
        + (f", the first frame without compiled kernels {figures['cold_first_frame_s']:.0f} s" if "cold_first_frame_s" in figures else ""),
        f"CPU {figures['cpu_s']:.1f} s ({used:.2f} cores), start-up included: {1e3 * figures['cpu_s'] / max(figures['frames'], 1):.1f} ms a frame;"
        f" peak memory {memory_text(figures)} MB",
    ]
    lines += [ate_text(figures)] if ate_text(figures) else []
    if "one_core" in figures:
        lines.append(_one_core_text(figures["one_core"], reference))
    if "peers" in figures:
        lines += ["", side_by_side(figures["peers"]["trihedron"], figures["peers"]["orbslam3"], reference)]
    return "\n".join(lines)


def ate_text(figures: dict[str, Any]) -> str:
    """The ATE of a run; empty without ground truth."""
    final = figures.get("metrics", {}).get("final")
    return f"ATE {final['ate_rmse_m']:.4f} m" if final else ""


def _one_core_text(figures: dict[str, Any], reference: float) -> str:
    live, latency = figures["live"], figures["frame_ms"]
    words = [
        f"on one core at the camera's rate: {live['taken']} of {live['came']} frames taken ({live['taken'] / max(live['came'], 1):.1%})",
        f"p50 {latency['p50']:.1f} ms, p95 {latency['p95']:.1f} ms ({latency['p95'] / reference:.2f} x reference)",
        f"{1e3 * figures['tracking_cpu_s'] / max(figures['frames'], 1):.1f} ms of CPU a frame",
        ate_text(figures),
    ]
    return ", ".join(word for word in words if word)
