"""The time of each stage

The runner measures every call. `timing.json` in the run folder has the median and the 95th percentile.
"""

import json
import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw the medians, and print the slowest stage."""
    with tempfile.TemporaryDirectory() as folder:
        th.run("dataset.length=30", out=folder, quiet=True)
        timing = json.loads((Path(folder) / "timing.json").read_text())
    stages = {name: stage["p50_ms"] for name, stage in timing["stages"].items() if name != "dataset"}
    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    axes.barh(list(stages), list(stages.values()))
    axes.invert_yaxis()
    axes.set_xlabel("ms a call, median")
    figure.savefig(out, dpi=90)
    print(f"{timing['frames']} frames of 640 x 480; the slowest stage is {max(stages, key=stages.__getitem__)}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "times.jpg"))
