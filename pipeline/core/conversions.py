"""Meshes and points as objects of Open3D and trimesh, which are imported when they are asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.libraries import imports_of

# Ten distinguishable colours (Okabe and Ito 2008, without black, and three more); the instances after the tenth begin again.
PALETTE = np.array(
    [[230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [0, 114, 178], [213, 94, 0], [204, 121, 167], [150, 90, 200], [140, 200, 60],
     [170, 120, 80]], np.uint8,
)  # fmt: skip


def mesh_to_open3d(vertices_m: NDArray[Any], triangles: NDArray[Any], colors: NDArray[np.uint8]) -> Any:
    """Make an `open3d.geometry.TriangleMesh` of (v, 3) vertices, (t, 3) triangles and (v, 3) colours. Raises LibraryError without Open3D."""
    o3d = _open3d()
    corners = o3d.utility.Vector3iVector(np.array(triangles, np.int32, order="C"))
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(_doubles(vertices_m)), corners)
    mesh.vertex_colors = o3d.utility.Vector3dVector(colors / 255.0)
    return mesh


def mesh_to_trimesh(vertices_m: NDArray[Any], triangles: NDArray[Any], colors: NDArray[np.uint8]) -> Any:
    """Make a `trimesh.Trimesh`, with the vertices in their order."""
    import trimesh

    return trimesh.Trimesh(_doubles(vertices_m), np.asarray(triangles, np.int64), vertex_colors=np.array(colors), process=False)


def points_to_open3d(points_m: NDArray[Any], colors: NDArray[np.uint8] | None = None) -> Any:
    """Make an `open3d.geometry.PointCloud` of (n, 3) points and (n, 3) colours. Raises LibraryError without Open3D."""
    o3d = _open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(_doubles(points_m)))
    if colors is not None:
        cloud.colors = o3d.utility.Vector3dVector(colors / 255.0)
    return cloud


def points_to_trimesh(points_m: NDArray[Any], colors: NDArray[np.uint8] | None = None) -> Any:
    """Make a `trimesh.PointCloud`."""
    import trimesh

    return trimesh.PointCloud(_doubles(points_m), colors=None if colors is None else np.array(colors))


def color_of_rows(rows: NDArray[Any]) -> NDArray[np.uint8]:
    """Return (n, 3) RGB for (n,) numbers of instances: the same for the same number."""
    colors: NDArray[np.uint8] = PALETTE[np.asarray(rows) % len(PALETTE)]
    return colors


def _open3d() -> Any:
    with imports_of("open3d"):
        import open3d
    return open3d


def _doubles(points: NDArray[Any]) -> NDArray[np.float64]:
    """Copy an array: those of a value are read-only, which Open3D refuses."""
    return np.array(points, np.float64, order="C")
