"""A floor plan

The slot `building` turns planes of the map into storeys, walls and rooms.
"""

import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw walls and rooms, and print their sizes."""
    words = ("dataset.width=320", "dataset.height=240", "dataset.length=150", "outputs=[trajectory,building]")
    with tempfile.TemporaryDirectory() as folder:
        plan = next(iter(th.run(*words, out=folder, quiet=True).recording.values("building")))
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.subplots()
    for _, first, end in plan.loops:
        axes.fill(*plan.corners_m[first:end].T, color="0.9")
    for ends in plan.walls_m:
        axes.plot(*ends.T, color="black", linewidth=3)
    axes.set(aspect="equal", xlabel="m", ylabel="m")
    figure.savefig(out, dpi=90)
    print(f"storeys: {len(plan.storeys)}, walls: {len(plan.walls_m)}, rooms: {len(plan.room_storeys)}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "plan.jpg"))
