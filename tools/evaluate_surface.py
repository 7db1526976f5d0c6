"""Judge a mesh by the true surface: accuracy, completeness, triangles and bytes, planar and curved parts apart where the truth distinguishes them.

MESH is a run folder, whose surface.ply is judged, or a file (ply, obj) in the world of the trajectory beside it, or else beside TRUTH. TRUTH is the
run's recording, or its folder: the truth is that of its data set, the exact surface of the synthetic scenes, rendered depth for ICL-NUIM. By
default the mesh's own folder, which then keeps the figures as surface.json. The mesh is moved by the SE(3) that aligns trajectory.txt with the
ground truth, never by itself.

Accuracy is the distance from the mesh to the truth, over its area. Completeness is the share of the truth that was seen, where a sensor reading
fell, that is within 2 and 5 cm of the mesh; what cannot be seen counts for nothing.

Example: trihedron evaluate-surface runs/latest runs/latest/run.mcap
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from trihedron.comparison.surface_errors import WITHIN_M, evaluate_files
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.record.mcap_file import recording_file
from trihedron.plugins.surface.files import SURFACE, SURFACE_ERRORS
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises DataError for files that cannot be judged, UsageError for wrong arguments."""
    parser = Parser("evaluate-surface", __name__)
    parser.add_argument("mesh", metavar="MESH", type=Path, help="a run folder or a mesh file")
    parser.add_argument("truth", metavar="TRUTH", type=Path, nargs="?", help="the run's recording or folder (default: that of MESH)")
    parser.add_argument("--json", action="store_true", help="print every figure as JSON")
    arguments = parser.parse(argv)
    mesh: Path = arguments.mesh / SURFACE if arguments.mesh.is_dir() else arguments.mesh
    truth: Path = arguments.truth or mesh.parent
    figures = evaluate_files(mesh, recording_file(truth))
    if arguments.mesh.is_dir() and arguments.truth is None:
        write_file(arguments.mesh / SURFACE_ERRORS, json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2) if arguments.json else report(figures))
    return 0


def report(figures: dict[str, Any]) -> str:
    """The figures as a table for people."""
    rows = [["", "mean cm", "RMSE cm", "95 % cm", *(f"within {1e2 * limit:.0f} cm" for limit in WITHIN_M)]]
    for part, found in figures["parts"].items():
        centimetres = [_number(found[name], 1e2, "{:.2f}") for name in ("mean_m", "rmse_m", "p95_m")]
        rows.append([part, *centimetres, *(_number(found[f"within_{1e2 * limit:.0f}_cm"], 1.0, "{:.1%}") for limit in WITHIN_M)])
    return "\n".join([table(rows, "lrrrrr"), f"{figures['triangles']} triangles, {figures['area_m2']:.1f} m², {figures['bytes']} bytes"])


def _number(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else form.format(value * factor)
