"""Meshes from files of any program."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, LibraryError, printable
from trihedron.pipeline.core.files import SHOWN, read_file
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.types import F64, I32

MAX_BYTES = 1 << 31
CURE = "give a .ply or .obj file"


def read_mesh(path: Path) -> tuple[F64, I32]:
    """Vertices (v, 3) and triangles (t, 3) of a PLY or OBJ file; polygons become triangles. Raises DataError, LibraryError."""
    if not path.exists():
        raise DataError(str(path), "there is no such file", "run with 'outputs=[trajectory,surface]' first")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("ply", "obj"):
        raise DataError(str(path), f"'{path.suffix}' is not a mesh file this program reads", CURE)
    try:
        found = _load_mesh(path, kind)
        points = np.asarray(found.vertices, np.float64).reshape(-1, 3)
        triangles = np.asarray(getattr(found, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
    except LibraryError:
        raise
    except Exception as error:  # trimesh raises anything for a damaged file
        raise DataError(str(path), f"is not a mesh: {printable(str(error) or type(error).__name__, 2 * SHOWN)}", CURE) from error
    if not np.isfinite(points).all():
        raise DataError(str(path), "has a vertex that is not finite", "the file is damaged; write it again")
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(points)):
        raise DataError(str(path), "a face names a vertex that is not there", "the file is damaged; write it again")
    return points, triangles.astype(np.int32)


def _load_mesh(path: Path, kind: str) -> Any:
    with imports_of("trimesh"):
        import trimesh

    data = BytesIO(read_file(path, MAX_BYTES))
    return trimesh.load_mesh(data, file_type=kind, process=False, maintain_order=True, skip_materials=True)
