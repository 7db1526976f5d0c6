"""Time a run per frame and stage, with its memory, beside a fixed reference workload of the same minute and frames.

The machine's speed varies, so times are also given as multiples of the reference: OpenCV ORB (1000 features, 8 levels) and LSD on the same frames,
one thread. Other comparisons, each with its --help: `trihedron benchmark manhattan` (estimators of the Manhattan frame on rendered rooms),
`trihedron benchmark rotations` (the runs of a sweep over them), `trihedron benchmark surface` (all surfaces, by the true one),
`trihedron benchmark map` (drift, recovery and growth of the map), `trihedron benchmark recording` (what recording costs). `trihedron compare` makes
a table of the runs of any sweep.

Example: trihedron benchmark dataset=tum dataset.path=FOLDER dataset.frames=0:150 --json benchmark.json
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trihedron.pipeline.types import U8

REFERENCE_FRAMES = 40
COMPARISONS = {  # other words after `benchmark`, and whose `main` they stand for
    "manhattan": "trihedron.tools.manhattan_family",
    "map": "trihedron.tools.map_benchmark",
    "recording": "trihedron.tools.recording_benchmark",
    "rotations": "trihedron.tools.rotation_comparison",
    "surface": "trihedron.tools.surface_family",
}


def main(argv: list[str]) -> int:
    """Run `trihedron run` with the given overrides in a process of its own, then the reference; print a table and optionally write JSON.
    A word of COMPARISONS hands over to that."""
    if argv[:1] and argv[0] in COMPARISONS:
        comparison: Any = importlib.import_module(COMPARISONS[argv[0]])
        return int(comparison.main(argv[1:]))
    parser = argparse.ArgumentParser(prog="trihedron benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="as for trihedron run")
    parser.add_argument("--json", metavar="FILE", help="write the figures too")
    options, rest = parser.parse_known_args(argv)
    overrides = [*options.overrides, *rest]
    with tempfile.TemporaryDirectory() as folder:
        figures = measure([*overrides, f"out={folder}/run"], Path(folder) / "run")
    figures["reference_ms"] = reference_ms(first_images(overrides))
    figures["machine"] = machine()
    print(table(figures))
    if options.json:
        Path(options.json).write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def measure(overrides: list[str], out: Path) -> dict[str, Any]:
    """`timing.json` and metrics of one run in its own process, with its peak resident memory in MB. Raises TrihedronError when it fails."""
    from trihedron.pipeline.errors import StageError

    began = time.perf_counter()
    command = [sys.executable, "-c", "import sys; from trihedron.pipeline.cli import main; sys.exit(main(['run', *sys.argv[1:]]))", *overrides]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    errors = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status):
        said = errors.strip().splitlines()[-1].removeprefix("trihedron: ") if errors.strip() else "without a word"
        raise StageError("benchmark", f"the run failed: {said}", "mend that first")
    figures: dict[str, Any] = json.loads((out / "timing.json").read_text())
    figures["peak_memory_mb"] = round(usage.ru_maxrss / 1024)
    figures["cpu_s"] = round(usage.ru_utime + usage.ru_stime, 2)
    figures["process_s"] = round(time.perf_counter() - began, 2)
    if (out / "metrics.json").exists():
        figures["metrics"] = json.loads((out / "metrics.json").read_text())
    return figures


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {"system": platform.platform(), "python": platform.python_version(), "cpus": os.cpu_count()}


def first_images(overrides: list[str]) -> list[U8]:
    """Grey images (h, w) of the run's first frames."""
    from hydra import compose, initialize_config_module

    from trihedron.pipeline.config import make_plugin, register_configs
    from trihedron.pipeline.registry import load_plugins

    load_plugins()
    register_configs()
    with initialize_config_module("trihedron.conf", version_base="1.3"):
        config = compose("root", overrides=overrides)
    dataset = make_plugin("dataset", config.dataset)
    frames = [dataset(i) for i in range(min(REFERENCE_FRAMES, len(dataset)))]
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


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    reference = figures["reference_ms"]
    frame = figures["frame_ms"]
    per_frame = 1e3 / figures["fps"] if figures["fps"] else 0.0
    lines = [
        f"{figures['frames']} frames, {figures['threads']} threads, reference workload {reference:.1f} ms",
        f"{'':14} {'p50 ms':>8} {'p95 ms':>8} {'x reference':>12}",
        f"{'frame':14} {frame['p50']:8.1f} {frame['p95']:8.1f} {frame['p50'] / reference:12.2f}",
        f"{'throughput':14} {per_frame:8.1f} {'':8} {per_frame / reference:12.2f}   ({figures['fps']:.1f} frames/s)",
    ]
    for name, stage in figures["stages"].items():
        lines.append(f"  {name:12} {stage['p50_ms']:8.2f} {stage['p95_ms']:8.2f} {stage['p50_ms'] / reference:12.2f}")
    lines.append(f"start-up {figures['startup_s']:.1f} s, CPU {figures['cpu_s']:.1f} s, peak memory {figures['peak_memory_mb']} MB")
    final = figures.get("metrics", {}).get("final")
    if final:
        lines.append(f"ATE {final['ate_rmse_m']:.4f} m")
    return "\n".join(lines)
