"""Tests compile what they call; none fills the cache for the whole default graph first. Those of plugins on Open3D need a library that loads."""

import os
import re

import pytest

import trihedron  # noqa: F401  # before NumPy, so that OpenBLAS rounds alike in all processes

os.environ["TRIHEDRON_COMPILE"] = "0"
ON_OPEN3D = re.compile(r"open3d|\b(graph=)?libraries\b")


def pytest_collection_modifyitems(items):
    try:
        import open3d  # noqa: F401
    except ImportError as error:
        skip = pytest.mark.skip(reason=f"open3d does not load: {error}")
        for item in items:
            call = getattr(item, "callspec", None)
            if call is not None and "path" not in call.params and ON_OPEN3D.search(call.id):
                item.add_marker(skip)
