"""Check a plugin against the contract of its slot, as `check_estimator` of scikit-learn does: ours, or one of a package that is installed.

It is called on the inputs that the default graph gives it in a synthetic room, on noisy repeats of one view of it, and in adverse scenes: no depth,
darkness, noise, a single row, frames that repeat, no features. Checked are documentation and ranges of the options, types, shapes and frames of the
values, what the slot's docstring promises of them, by the truth of the room (signs, positions, moments, covariances against scatter and error, ids,
stamps), unchanged inputs, no hidden state, equal bytes over threads, processes and a replay, the library it names, a difference from the default
plugin, and time. A data set is read, with dataset.path=FOLDER. Other words configure the plugin and the graph that feeds it. `ok` is followed by the
figure that is nearest to its limit; `-` marks a check that had nothing to judge. Exit code 0, or 1 when something is wrong.

Example: trihedron check planes open3d_patches planes.min_points=200
"""

from __future__ import annotations

import sys

from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises TrihedronError for a slot, a plugin or an option that does not exist."""
    parser = Parser("check", __name__)
    parser.add_argument("slot", metavar="SLOT")
    parser.add_argument("plugin", metavar="PLUGIN")
    parser.add_argument("words", metavar="KEY=VALUE", nargs="*", help="options, as for trihedron run")
    parser.add_argument("--quick", action="store_true", help="leave out other processes and the replay")
    parser.add_argument("--digest", action="store_true", help="print the SHA-256 of the values in the room, and nothing else")
    arguments = parser.parse(argv)
    from trihedron.tools.plugin_check import PluginCheck

    check = PluginCheck(arguments.slot, arguments.plugin, tuple(arguments.words))
    if arguments.digest:
        print(check.digest())
        return 0
    print(f"{arguments.slot}={arguments.plugin}: {check.summary}")
    results = check.results(quick=arguments.quick)
    print(table([(f"  {one.name}", one.status, one.detail) for one in results]))
    wrong, skipped = sum(not one.good for one in results), sum(not one.judged for one in results)
    success = f"all is well; {skipped} of {len(results)} checks had nothing to judge (-)" if skipped else "all is well"
    print(f"{wrong} of {len(results)} checks failed" if wrong else success)
    sys.stdout.flush()
    return 1 if wrong else 0
