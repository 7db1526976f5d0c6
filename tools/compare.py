"""The runs of sweeps, and single runs, as one table: what each one changed, what it tracked, its errors, its time and its memory.

A row is what a run's overrides say that those of the others do not; runs that differ in their seed alone share a row, as median ± half the distance
from the smallest to the largest, and the mean of their ATE ± half its 95 % interval by Student's t. Rows of one data set stand together; the best of
each column is bold, errors only among rows that tracked almost as much as the best. `end to start` is where a run without ground truth ends, seen
from where it began: the drift of a walk that returns.
`--baseline` adds the mean paired difference (same data, same seeds) with its 95 % interval by Student's t, per row and over all data, and prints
verdicts first, as `trihedron ablate` does: of each change against the baseline, over all pairs of runs; of a single pair by the errors of its frames.
A job that failed, or has no errors, has a row with the reason.

Trajectory files of other programs (TUM format, or KITTI with a pose a frame) are rows of the same table, judged on the frames and the ground truth of
the runs beside them, by the same association, alignment and share tracked. Files of one label are repeats of each other.

Example: trihedron compare runs/table --baseline graph=points --markdown table.md
Example: trihedron compare runs/desk orbslam2.txt --label ORB-SLAM2
"""

from __future__ import annotations

from pathlib import Path

from trihedron.comparison import run_tables as render
from trihedron.comparison.run_samples import COLUMNS
from trihedron.comparison.runs import judge_surfaces, read_runs, read_trajectories, rows_of, verdicts_against, with_verdicts
from trihedron.comparison.verdicts import NOTE, VERDICTS, line_of
from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.files import write_file
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises DataError when a folder holds no runs, UsageError without folders and for an
    unknown baseline."""
    parser = Parser("compare", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of sweeps, of single runs; trajectories of other programs")
    parser.add_argument("--label", action="append", default=[], metavar="NAME", help="of the trajectories: one for all, or one for each")
    parser.add_argument("--y-up", action="store_true", help="the trajectories' y axis points up (as with fy = -480 on ICL-NUIM)")
    parser.add_argument("--baseline", default="", metavar="CHANGE", help="the row, for example graph=points, the others are compared with")
    parser.add_argument("--surfaces", action="store_true", help="judge each surface.ply that was not yet (as evaluate-surface does)")
    for name in render.WRITERS:
        parser.add_argument(f"--{name}", type=Path, metavar="FILE", help="write the table there too")
    options = parser.parse(argv)
    folders, files = [path for path in options.folders if not path.is_file()], [path for path in options.folders if path.is_file()]
    if not folders:
        raise UsageError("compare", "there are trajectories and no run", "give the folder of a run of the same data set before them")
    if options.surfaces:
        judge_surfaces(folders)
    runs = read_runs(*folders)
    found = verdicts_against(runs, options.baseline)
    rows = with_verdicts(rows_of(runs + read_trajectories(files, runs, options.label, options.y_up), options.baseline), found)
    lines = [line_of(one, COLUMNS[one.figure]) for one in found]
    if lines:
        print("\n".join([VERDICTS, *lines, NOTE, ""]))
    print(render.as_text(rows))
    for name, write in render.WRITERS.items():
        if getattr(options, name):
            write_file(getattr(options, name), write(rows, lines))
    return 0
