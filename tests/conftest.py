"""Tests compile what they call; none fills the cache for the whole default graph first. Runs draw no picture, and skips are accounted for."""

import gc
import os
import sys
from pathlib import Path

import pytest

from trihedron.pipeline.app import execute

sys.path.insert(0, str(Path(__file__).parent))
from skips import pytest_collection_modifyitems, pytest_sessionfinish, pytest_terminal_summary  # noqa: F401

os.environ["TRIHEDRON_COMPILE"] = "0"
SLOW_S = 3600  # limit of a slow test that states none; the others have that of pyproject.toml


@pytest.fixture(scope="session", autouse=True)
def no_pictures():
    """Runs leave an empty file in the place of the picture of their trajectory: to draw it takes longer than a short run.
    tests/pipeline/test_trajectory_plot.py draws, and so does the test of a complete run folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(execute, "trajectory_figure", lambda estimate, truth, path, status=(): path.touch())
        yield


@pytest.fixture(scope="module", autouse=True)
def modules_are_left_out_of_collections():
    """A run collects garbage when it starts, to measure its own peak of memory. What is there before the tests of a file, mostly
    modules of libraries, lives as long as the process; to look through it each time takes longer than to start the run."""
    gc.collect()
    gc.freeze()


def pytest_itemcollected(item):
    if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
        item.add_marker(pytest.mark.timeout(SLOW_S))
