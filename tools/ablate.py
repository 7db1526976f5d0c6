"""Swap stages of recorded runs, compute again only what follows from them, and say what each swap changes and where.

From each recording every combination of the given plugins, options or wires is computed, side by side: what they have in common is read or computed
once. Each alternative is a run folder in out=DIR. By default all that follows from a swap is computed again, as a full run would, to the same bytes;
with feedback=recorded each swapped stage by itself, on what was recorded, and each swap is an alternative by itself.

First the verdicts, a line for each pair of alternatives and figure: both figures, their difference with its 95 % interval, the effect size, and
"better", "worse" or "no difference shown" with how many seeds more would show one of 5 %. Of one recording the interval is from its frames (blocks of
at least a second; fewer than 8 blocks are "too short to tell"), of several from their differences. Holm's correction is over the pairs of a figure.

The tables: every alternative's figures; the Shapley value of each swap, and with --budget what the truth in the place of a stage changes; where they
part, with a picture of the worst frame; the cost.
The same command again computes only what is missing; with --dry-run it lists that, and what the alternatives share.

Example: trihedron ablate runs/a/run.mcap manhattan=mean_shift,plane_svd rotation=drift_free,procrustes out=runs/ablation
Example: trihedron ablate runs/a/run.mcap 'manhattan=*' feedback=recorded out=runs/axes
Example: trihedron ablate runs/seeds/*/run.mcap planes.angle_deg=2,3 bundle=none out=runs/ablation --markdown table.md
"""

from __future__ import annotations

import json
from pathlib import Path

from trihedron.comparison import ablation_tables as tables
from trihedron.comparison.ablation import ablate, known_cases, options_of, works_of
from trihedron.comparison.preview import preview
from trihedron.pipeline.core.files import write_file
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises TrihedronError, one line."""
    parser = Parser("ablate", __name__)
    parser.add_argument("words", nargs="+", metavar="RUN.mcap|SWAP", help="recordings; STAGE=PLUGIN,..., STAGE=*, STAGE.OPTION=VALUE,...; out=DIR")
    parser.add_argument("--budget", action="store_true", help="of a single recording: the truth in the place of stages too, which takes six replays")
    parser.add_argument("--dry-run", action="store_true", help="say what each alternative computes, reads and shares; compute nothing")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write figures and tables there too")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there too")
    given = parser.parse(argv)
    options = options_of(given.words, given.budget)
    if given.dry_run:
        works = works_of(options, known_cases(options.out))
        print("\n\n".join(preview(work.computing, work.combinations, work.folders, work.errors is not None) for work in works))
        return 0
    cases = ablate(options)
    found, sections = tables.verdicts(cases), tables.sections_of(cases)
    lines = tables.lines_of(found)
    print(tables.as_text(lines, sections))
    if given.markdown:
        write_file(given.markdown, tables.as_markdown(lines, sections))
    if given.json:
        write_file(given.json, json.dumps(tables.as_json(cases, found, sections), indent=2) + "\n")
    return 0
