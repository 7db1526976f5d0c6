"""Program that tracks prepared frames with ORB-SLAM3 (package `pyorbslam3`), in an interpreter that has it.

It is started by `trihedron.tools.peers` in a process of its own and needs that package and NumPy alone, nothing of this project.
`--find` prints as JSON whether the package loads and where its vocabulary is. With the file of a job it tracks the job's frames at the camera's rate,
and writes `poses.npy` ((n, 4, 4) T_world_camera, metres, NaN where it is lost), `final.txt` (TUM format, as corrected at the end) and
`result.json`; `progress` has a byte for each frame that is done. In the result, `frame_ms` is `track_rgbd` alone, with the arrays in memory, and
`arrival_ms` from when a frame is due to its pose, with reading its file.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

BEGAN = time.perf_counter()
PACKAGE = "pyorbslam3"
LONGEST_PAUSE_S = 1.0  # between two frames, whatever their stamps say


def find() -> dict[str, Any]:
    """Return `package` ("" where it loads, else why not), its `version` and the `vocabulary` that it would take, which need not exist."""
    if importlib.util.find_spec(PACKAGE) is None:
        return {"package": "is not installed"}
    try:
        import pyorbslam3
    except (ImportError, OSError) as error:
        return {"package": f"does not load ({error})"}
    from importlib.metadata import PackageNotFoundError, version

    try:
        number = version(PACKAGE)
    except PackageNotFoundError:
        number = "of unknown version"
    try:
        vocabulary = pyorbslam3.vocabulary_path(download=False)
    except FileNotFoundError:
        vocabulary = ""
    return {"package": "", "version": number, "vocabulary": str(vocabulary)}


def track(job: dict[str, Any]) -> None:
    """Track the frames of a job: `frames` (stamp in seconds and file of each), `vocabulary`, `settings`, `out`."""
    import numpy as np
    import pyorbslam3

    out = Path(job["out"])
    progress = (out / "progress").open("wb", buffering=0)
    before = time.perf_counter()
    slam = pyorbslam3.Slam(job["vocabulary"], job["settings"], sensor=pyorbslam3.Sensor.RGBD)
    load_s = time.perf_counter() - before
    poses = np.full((len(job["frames"]), 4, 4), np.nan)
    frame_ms, arrival_ms, threads, reading_s, first_pose_s = [], [], 0, 0.0, None
    due, last, cpu_s = time.perf_counter(), job["frames"][0][0], time.process_time()
    for number, (stamp_s, file) in enumerate(job["frames"]):
        due, last = due + min(stamp_s - last, LONGEST_PAUSE_S), stamp_s
        time.sleep(max(due - time.perf_counter(), 0.0))
        read = time.thread_time()
        with np.load(file, allow_pickle=False) as arrays:
            color, depth_m = arrays["color"], arrays["depth_m"]
        reading_s += time.thread_time() - read
        began = time.perf_counter()
        found = slam.track_rgbd(color, depth_m, stamp_s)
        ended = time.perf_counter()
        frame_ms.append(1e3 * (ended - began))
        arrival_ms.append(1e3 * (ended - due))
        if found.ok:  # `pose_valid` is true of the last pose, too, in the seconds after it is lost
            poses[number] = found.pose_wc
            first_pose_s = ended - BEGAN if first_pose_s is None else first_pose_s
        threads = max(threads, int(_status("Threads")))
        progress.write(b".")
    progress.close()
    cpu_s = time.process_time() - cpu_s - reading_s
    np.save(out / "poses.npy", poses)
    figures = {"frame_ms": frame_ms, "arrival_ms": arrival_ms, "cpu_s": cpu_s, "threads": threads, "load_s": load_s, "first_pose_s": first_pose_s}
    figures["peak_memory_mb"] = 1.024e-3 * int(_status("VmHWM"))
    slam.shutdown()
    if first_pose_s is not None:
        slam.save_trajectory_tum(str(out / "saved.txt"))
        _write_once(out / "saved.txt", out / "final.txt")
    (out / "result.json").write_text(json.dumps(figures))


def _write_once(saved: Path, final: Path) -> None:
    """Copy a trajectory without the repeats of the last pose, stamp and all, which ORB-SLAM3 saves for each frame in which it is lost."""
    lines: dict[str, str] = {}
    for line in saved.read_text().splitlines(keepends=True):
        lines.setdefault(line.partition(" ")[0], line)
    final.write_text("".join(lines.values()))


def _status(name: str) -> str:
    """Return a number of this process as the system states it (memory in kB)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(line.split()[1] for line in lines if line.startswith(f"{name}:"))


if __name__ == "__main__":
    if sys.argv[1:] == ["--find"]:
        print(json.dumps(find()))
    else:
        track(json.loads(Path(sys.argv[1]).read_text()))
        sys.stdout.flush()
        os._exit(0)  # destructors of ORB-SLAM3 are not needed any more, and may crash
