"""Which Manhattan estimator is better, and how sure is that?

Record a small room, three walks. Then swap the estimator in open loop: each alternative gets the recorded inputs, so that no later stage hides its
errors. The verdicts compare it with the recorded one; the bars of the picture are the 95 % intervals of the differences.
"""

import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

import trihedron as th

SMALL = ("dataset.width=160", "dataset.height=120", "dataset.length=40", "record.topics=[normals]")
MEASURE = "axes deg"  # the angle between the estimated and the true axes, root mean square over the frames


def main(out: Path) -> None:
    """Draw the measure of each estimator with its interval, and print the verdicts and the table."""
    with tempfile.TemporaryDirectory() as folder:
        walks = [th.run(*SMALL, f"dataset.seed={seed}", out=f"{folder}/{seed}", quiet=True) for seed in range(3)]
        found = th.ablate(walks, "manhattan=mean_shift,line_plane_ransac,mixture", out=f"{folder}/axes", feedback="recorded").figures

    figure = Figure(figsize=(7, 2.2), layout="constrained")
    axes = figure.subplots()
    for one in found["verdicts"]:
        if one["figure"] == MEASURE and one["first"] == "as recorded":
            middle = one["difference"]
            axes.errorbar([middle], [one["second"]], xerr=[[middle - one["low"]], [one["high"] - middle]], fmt="o", capsize=5)
            print(one["text"])
    axes.axvline(0.0, color="gray", linestyle="--")
    axes.margins(y=0.5)
    axes.set_xlabel("difference from mean_shift, degrees: left is better")
    figure.savefig(out, dpi=90)
    table = next(rows for title, rows in found["tables"].items() if title.startswith("Alternatives"))
    for row in table:
        print(f"{row['change']}: {MEASURE} {row[MEASURE]}, false axes {row['false axes %']} %")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "estimators.jpg"))
