"""Depth with more and more noise

`dataset=faults` stands before any data set and adds what a bad day would: here noise of the depth, in multiples of the sensor's own.
"""

import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

import trihedron as th

SMALL = ("+dataset.options.length=45", "+dataset.options.width=320", "+dataset.options.height=240")


def main(out: Path) -> None:
    """Draw the error over the noise, and print it."""
    levels, errors = (0, 1, 2, 4), []
    for level in levels:
        with tempfile.TemporaryDirectory() as folder:
            done = th.run("dataset=faults", f"dataset.depth_noise={level}", *SMALL, out=folder, quiet=True)
        errors.append(1e3 * done.metrics["final"]["ate_rmse_m"])
        print(f"noise of {level} standard deviations added: ATE {errors[-1]:.1f} mm")
    figure = Figure(figsize=(5, 2.8), layout="constrained")
    axes = figure.subplots()
    axes.plot(levels, errors, marker="o")
    axes.set(xlabel="noise added, σ of the sensor", ylabel="ATE, mm", ylim=(0, None))
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "noise.jpg"))
