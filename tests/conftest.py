"""Tests compile what they call; none fills the cache for the whole default graph first. Those of plugins on Open3D need a library that loads."""

import os
import re

import pytest

os.environ["TRIHEDRON_COMPILE"] = "0"
SLOW_S = 3600  # limit of a slow test that states none; the others have that of pyproject.toml
ON_OPEN3D = re.compile(r"open3d|\b(graph=)?libraries\b")


def pytest_collection_modifyitems(items):
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_S))
    try:
        import open3d  # noqa: F401
    except ImportError as error:
        skip = pytest.mark.skip(reason=f"open3d does not load: {error}")
        for item in items:
            call = getattr(item, "callspec", None)
            if call is not None and "path" not in call.params and ON_OPEN3D.search(call.id):
                item.add_marker(skip)
