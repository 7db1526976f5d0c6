"""Print which estimator of the Manhattan frame has the characteristic of which other: a table of the family, for the documentation.

Usage: python tests/plugins/manhattan_characteristics.py
"""

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from direction_world import Directions

from trihedron.pipeline.core.registry import load_plugins, plugins_of

CHARACTERISTICS = {  # estimator whose test states it -> module and function of the test, the characteristic in words
    "mean_shift": ("test_manhattan", "lesser_modes", "follows the modes near the previous axes among stronger ones"),
    "branch_and_bound": ("test_manhattan_branch_and_bound", "certificate", "finds the best from any start, with a certificate"),
    "plane_svd": ("test_manhattan_plane_svd", "planes_rule", "believes planes against many other normals and lines"),
    "line_plane_ransac": ("test_manhattan_line_plane_ransac", "one_plane_and_one_line", "needs one plane and one line"),
    "von_mises_fisher": ("test_manhattan_von_mises_fisher", "spread_of_every_axis", "reports the spread of each axis"),
    "mixture": ("test_manhattan_mixture", "identities", "keeps the identities of several frames"),
    "atlanta": ("test_manhattan_atlanta", "one_vertical", "several frames share one vertical"),
}


def has(estimator, module, function):
    """Return True if the estimator passes the test of a characteristic."""
    try:
        getattr(importlib.import_module(module), function)(estimator, Directions())
    except (AssertionError, TypeError, ValueError, IndexError, AttributeError):  # an answer of another form has it not
        return False
    return True


def main():
    load_plugins()
    print("| characteristic | " + " | ".join(f"`{name}`" for name in CHARACTERISTICS) + " |")
    print("|---|" + "---|" * len(CHARACTERISTICS))
    for module, function, words in CHARACTERISTICS.values():
        answers = [has(plugins_of("manhattan")[name](), module, function) for name in CHARACTERISTICS]
        print(f"| {words} | " + " | ".join("yes" if answer else "no" for answer in answers) + " |")


if __name__ == "__main__":
    main()
