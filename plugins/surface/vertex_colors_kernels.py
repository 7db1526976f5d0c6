"""Kernel of `vertex_colors.py`: colours of points from one view."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, U8


@kernel
def paint(points: F32, normals: F32, depth: F32, color: U8, R: F32, position: F32, intrinsics: F32, near: F32, total: F32) -> None:
    """Add the colours one view gives, times their weight, and the weight, to `total` (n, 4). R is `R_camera_world`."""
    h, w = depth.shape
    for i in range(len(points)):
        gx, gy, gz = points[i, 0] - position[0], points[i, 1] - position[1], points[i, 2] - position[2]
        z = R[2, 0] * gx + R[2, 1] * gy + R[2, 2] * gz
        if z < 0.1:
            continue
        u = intrinsics[0] * (R[0, 0] * gx + R[0, 1] * gy + R[0, 2] * gz) / z + intrinsics[2]
        v = intrinsics[1] * (R[1, 0] * gx + R[1, 1] * gy + R[1, 2] * gz) / z + intrinsics[3]
        if u < 0.0 or v < 0.0 or u > w - 1.0 or v > h - 1.0:
            continue
        facing = -(normals[i, 0] * gx + normals[i, 1] * gy + normals[i, 2] * gz)
        d = depth[int(v + 0.5), int(u + 0.5)]
        if d <= 0.0 or facing <= 0.0 or abs(d - z) > near[min(int(10.0 * z), len(near) - 1)]:
            continue
        seen = facing / (gx * gx + gy * gy + gz * gz) ** 1.5  # solid angle of a unit of surface
        weight = seen * seen * seen
        x, y = min(int(u), w - 2), min(int(v), h - 2)
        a, b = u - x, v - y
        for k in range(3):
            upper = (1.0 - a) * color[y, x, k] + a * color[y, x + 1, k]
            lower = (1.0 - a) * color[y + 1, x, k] + a * color[y + 1, x + 1, k]
            total[i, k] += weight * ((1.0 - b) * upper + b * lower)
        total[i, 3] += weight
