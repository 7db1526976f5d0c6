"""Plugins by which Hydra runs sweeps, by the names under which the configuration has them."""

from __future__ import annotations

from hydra.core.plugins import Plugins

from trihedron.pipeline.core.config import DASK, SEARCH, SWEEPER
from trihedron.pipeline.sweep.cluster import Dask
from trihedron.pipeline.sweep.search import Search
from trihedron.pipeline.sweep.sweep import OUTCOMES, Outcome, Sweeper


def register_engines() -> list[Outcome]:
    """Let Hydra know sweepers and launcher; call before its main. Hydra takes only names in its own namespace. Returns the list, emptied, that
    takes what its sweeps come to."""
    OUTCOMES.clear()
    Plugins.instance().class_name_to_class.update({SWEEPER: Sweeper, SEARCH: Search, DASK: Dask})
    return OUTCOMES
