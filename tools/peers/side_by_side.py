"""ORB-SLAM3 on the frames of a benchmark, in a process of its own, and its figures beside ours.

The program `orbslam3.py` beside this file runs in an interpreter that has the package `pyorbslam3`, which is no dependency of this project and is
never imported by it. Both systems get the frames that the data set delivers, at the camera's rate; both trajectories are judged by the same code.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison.other_programs import Reference, judge, references
from trihedron.pipeline.core.errors import DataError, TrihedronError, UsageError, printable
from trihedron.pipeline.core.options import frame_range
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import F64, Camera, Trajectory
from trihedron.pipeline.record.codec import TIMING_TOPIC, timing_of
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import write_trajectory
from trihedron.pipeline.run.metrics import FEWEST_POSES

PROGRAM = Path(__file__).with_name("orbslam3.py")
NAME = "ORB-SLAM3"
PLACE = "benchmark --peers"
FIND_S, LIMIT_S, LIMIT_FRAME_S = 60.0, 60.0, 1.0  # how long the program may take: to find the package, to track, and more for each frame
NOT_A_ROTATION = 1e-3  # largest element of R Rᵀ − I; poses come in single precision
BASELINE_M, FAR = 0.0747, 40.0  # of the published settings: depth beyond their product is taken for far
SETTINGS = """%YAML:1.0
---
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {camera.fx:.9f}
Camera1.fy: {camera.fy:.9f}
Camera1.cx: {camera.cx:.9f}
Camera1.cy: {camera.cy:.9f}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {camera.width}
Camera.height: {camera.height}
Camera.fps: {fps}
Camera.RGB: 1
Stereo.ThDepth: {far}
Stereo.b: {baseline_m}
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""  # the viewer is off, and its numbers are demanded all the same


@dataclass(frozen=True)
class Peer:
    """An interpreter that has the package, the package's version, and the vocabulary to use."""

    python: str
    version: str
    vocabulary: Path


@dataclass(frozen=True)
class Job:
    """The prepared frames: the file that describes them to the program, the folder of its results, and their stamps."""

    file: Path
    out: Path
    stamps_ns: Sequence[int]


def find_peer(python: str, vocabulary: Path | None) -> Peer:
    """Return what `python` has of ORB-SLAM3. Raises UsageError where interpreter, package or vocabulary is missing."""
    try:
        done = subprocess.run([python, str(PROGRAM), "--find"], capture_output=True, text=True, timeout=FIND_S)
        found = json.loads(done.stdout)
        package, version, in_cache = (str(found.get(key, "")) for key in ("package", "version", "vocabulary"))
    except OSError as error:
        raise UsageError("--peer-python", f"{python} cannot be started ({error.strerror})", "give the path of a Python interpreter") from None
    except (subprocess.TimeoutExpired, ValueError, AttributeError):
        raise UsageError("--peer-python", f"{python} does not say what it has", "give the path of a Python interpreter, 3.9 or newer") from None
    if package:
        cure = "pip install pyorbslam3 (GPL-3; Linux, Python 3.9 to 3.13) in an environment of its own, and give --peer-python ITS_PYTHON"
        raise UsageError(PLACE, f"pyorbslam3 {package} in {python}", cure)
    chosen = vocabulary if vocabulary is not None else Path(in_cache)
    if not chosen.is_file():
        cause = f"there is no vocabulary at {chosen}" if vocabulary is not None or in_cache else f"{NAME} needs a vocabulary, and its cache has none"
        cure = "unpack Vocabulary/ORBvoc.txt.tar.gz of https://github.com/UZ-SLAMLab/ORB_SLAM3, and give --vocabulary ORBvoc.txt"
        raise UsageError(PLACE, cause, cure)
    return Peer(python, version, chosen.absolute())


def write_job(dataset: Any, peer: Peer, folder: Path) -> Job:
    """Write the frames of a data set as `.npz` files (`color`, (h, w, 3) RGB; `depth_m`, (h, w) metres) with settings and the file of the job.
    Raises DataError where there are no frames, or no room."""
    frames, camera = {}, None
    try:
        folder.mkdir()
        for number in range(len(dataset)):
            if (frame := dataset(number)) is not None:
                file, camera = folder / f"{number:06}.npz", camera or frame.camera
                np.savez(file, color=frame.color, depth_m=frame.depth_m)
                frames[frame.stamp_ns] = str(file)
        if camera is None:
            raise DataError(PLACE, "no frame can be read", "see trihedron run with the same words")
        stride = frame_range(str(getattr(dataset, "frames", ""))).step
        (folder / "settings.yaml").write_text(settings_of(replace(camera, fps=camera.fps / stride)))
        job = {"vocabulary": str(peer.vocabulary), "settings": str(folder / "settings.yaml"), "out": str(folder)}
        (folder / "job.json").write_text(json.dumps({**job, "frames": [(stamp_ns / 1e9, file) for stamp_ns, file in frames.items()]}))
    except OSError as error:
        cure = "make room there (2 MB a frame), set TMPDIR, or take fewer frames: dataset.frames=0:150"
        raise DataError(str(folder), f"frames cannot be written ({error.strerror})", cure) from error
    return Job(folder / "job.json", folder, list(frames))


def settings_of(camera: Camera) -> str:
    """Return the settings of ORB-SLAM3 for a camera: the published ones, depth in metres, the viewer off."""
    return SETTINGS.format(camera=camera, fps=max(round(camera.fps), 1), far=FAR, baseline_m=BASELINE_M)


def peer_figures(peer: Peer, job: Job, run: Path) -> dict[str, Any]:
    """Run ORB-SLAM3 on a job, and judge it by the frames and the ground truth of our run in folder `run`. A crash, a hang or results that cannot be
    read are `failed`, a text."""
    limit_s = LIMIT_S + LIMIT_FRAME_S * len(job.stamps_ns)
    log = job.out / "log.txt"
    try:
        with log.open("w") as file:
            done = subprocess.run([peer.python, str(PROGRAM), str(job.file)], stdout=file, stderr=subprocess.STDOUT, timeout=limit_s)
        if done.returncode:
            return {"failed": f"{_ending(done.returncode, log)}, {_progress(job)}"}
        figures, poses = _results(job)
    except subprocess.TimeoutExpired:
        return {"failed": f"did not end within {limit_s:.0f} s, {_progress(job)}"}
    except (OSError, ValueError, KeyError, TypeError, EOFError) as error:
        return {"failed": printable(f"left no results that can be read ({error})", 200)}
    tracked = np.isfinite(poses).all(axis=(1, 2))
    causal = Trajectory(np.array(job.stamps_ns, np.int64)[tracked], poses[tracked])
    figures |= {"version": peer.version, "tracked_share": round(float(tracked.mean()), 4)}
    figures |= {"ate_rmse_m": None, "causal_ate_rmse_m": None}
    if len(causal) >= FEWEST_POSES and (candidates := references([(run, {})])):
        write_trajectory(job.out / "causal.txt", causal)
        figures |= {"ate_rmse_m": _ate(job.out / "final.txt", candidates), "causal_ate_rmse_m": _ate(job.out / "causal.txt", candidates)}
    return figures


def _progress(job: Job) -> str:
    """Return how far the program came."""
    file = job.out / "progress"
    return f"after {file.stat().st_size if file.exists() else 0} of {len(job.stamps_ns)} frames"


def _ending(code: int, log: Path) -> str:
    """Return how a process ended that did not end well, with its last words."""
    if code < 0:
        return f"was ended by {signal.Signals(-code).name}"
    words = log.read_text(errors="replace").strip().splitlines()
    return printable(f"ended with exit code {code}" + (f" ({words[-1]})" if words else ""), 200)


def _results(job: Job) -> tuple[dict[str, Any], Any]:
    """Return the figures and (n, 4, 4) poses that the program wrote. Raises ValueError and the like for what is not as it should be."""
    found, count = json.loads((job.out / "result.json").read_text()), len(job.stamps_ns)
    frame_ms, arrival_ms = (np.array(found[name], np.float64) for name in ("frame_ms", "arrival_ms"))
    poses = np.load(job.out / "poses.npy", allow_pickle=False).astype(np.float64)
    if frame_ms.shape != (count,) or arrival_ms.shape != (count,) or poses.shape != (count, 4, 4):
        raise ValueError(f"{len(frame_ms)} times and {len(poses)} poses of {count} frames")
    R = poses[:, :3, :3]
    if np.nanmax(np.abs(np.einsum("nij,nkj->nik", R, R) - np.eye(3)), initial=0.0) > NOT_A_ROTATION:
        raise ValueError("a pose is none")
    numbers = {name: float(found[name]) for name in ("cpu_s", "threads", "load_s", "peak_memory_mb")}
    first_pose_s = None if found["first_pose_s"] is None else float(found["first_pose_s"])
    if not all(0.0 <= number < np.inf for number in (*frame_ms, *arrival_ms, *numbers.values(), first_pose_s or 0.0)):
        raise ValueError("a figure is no time or size")
    return {
        "ms": _percentiles(frame_ms),
        "arrival_ms": _percentiles(arrival_ms),
        "cpu_ms": round(1e3 * numbers["cpu_s"] / count, 2),
        "threads": int(numbers["threads"]),
        "peak_memory_mb": round(numbers["peak_memory_mb"], 1),
        "load_s": round(numbers["load_s"], 2),
        "first_pose_s": None if first_pose_s is None else round(first_pose_s, 2),
    }, poses


def _ate(file: Path, candidates: Sequence[Reference]) -> float | None:
    """Return the RMSE in metres, or None with a warning for a trajectory that cannot be judged."""
    try:
        return float(judge(file, candidates)[1]["ate_rmse_m"])
    except TrihedronError as error:
        print(f"trihedron: warning: {NAME}: {error}", file=sys.stderr)
        return None


def own_figures(unpaced: dict[str, Any], paced: dict[str, Any], run: Path) -> dict[str, Any]:
    """Return the figures of our runs (`benchmark.measure`) that stand beside those of a peer: of that at the camera's rate, in folder `run`, but for
    `ms`, the time from a frame in memory to its pose, which only the other knows."""
    metrics, count = paced.get("metrics", {}), max(paced["frames"], 1)
    first = next((timing_of(data) for _, data in Recording(run / "run.mcap").messages(TIMING_TOPIC)), {"frame_ms": 0.0})
    return {
        "ms": {name: unpaced["frame_ms"][name] for name in ("p50", "p95")},
        "arrival_ms": {name: paced["frame_ms"][name] for name in ("p50", "p95")},
        "cpu_ms": round(1e3 * paced["tracking_cpu_s"] / count, 2),
        "threads": paced["threads"],
        "peak_memory_mb": paced["peak_memory_mb"],
        "first_pose_s": round(paced["startup_s"] + 1e-3 * first["frame_ms"], 2),
        "tracked_share": round(1.0 - metrics["status"]["lost"] / count, 4) if metrics else None,
        "ate_rmse_m": (metrics.get("final") or {}).get("ate_rmse_m"),
        "causal_ate_rmse_m": (metrics.get("causal") or {}).get("ate_rmse_m"),
    }


def _percentiles(values: F64) -> dict[str, float]:
    p50, p95 = np.percentile(values, [50, 95])
    return {"p50": round(float(p50), 3), "p95": round(float(p95), 3)}


def side_by_side(own: dict[str, Any], peer: dict[str, Any], reference_ms: float) -> str:
    """Return the table of both systems and the reference workload, and a line on how the peer was run, or failed."""
    columns: list[dict[str, Any]] = [own, {} if "failed" in peer else peer, {"ms": {"p50": reference_ms}}]

    def row(label: str, key: str, part: str = "", scale: float = 1.0, digits: int = 1) -> list[str]:
        values = [column.get(key) for column in columns]
        values = [value.get(part) if isinstance(value, dict) else value for value in values]
        return [label, *("-" if value is None else f"{scale * value:.{digits}f}" for value in values)]

    rows = [
        ["", "Trihedron", NAME, "reference"],
        row("frame in memory to pose, p50 ms", "ms", "p50"),
        row("frame in memory to pose, p95 ms", "ms", "p95"),
        row("that p50 as x reference", "ms", "p50", 1.0 / reference_ms, 2),
        row("frame due to pose, with reading, p50 ms", "arrival_ms", "p50"),
        row("frame due to pose, with reading, p95 ms", "arrival_ms", "p95"),
        row("CPU, ms a frame", "cpu_ms"),
        row("peak memory, MB", "peak_memory_mb", digits=0),
        row("ATE of the final trajectory, mm", "ate_rmse_m", scale=1e3, digits=2),
        row("ATE of the poses as tracked, mm", "causal_ate_rmse_m", scale=1e3, digits=2),
        row("tracked, %", "tracked_share", scale=100.0),
        row("start to first pose, s", "first_pose_s"),
    ]
    if "failed" in peer:
        return table(rows, "lrrr") + f"\n{NAME}: {peer['failed']}"
    return table(rows, "lrrr") + (
        f"\n{NAME}: pyorbslam3 {peer['version']}, {peer['threads']} threads, {peer['load_s']:.1f} s to load the vocabulary"
        f"\nat the camera's rate, but for the first rows of Trihedron; its CPU and memory are with reading and recording, those of {NAME} without"
    )
