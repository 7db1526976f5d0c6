"""Normals by integral images: the paper's choice."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.common import patch_radii
from trihedron.plugins.normals.common_kernels import patch_normals


@register("normals", "integral_image")
@dataclass(frozen=True)
class IntegralImage:
    """Average the tangent vectors of a patch by integral images (Holzer et al., IROS 2012; paper, section III-A).

    Missing depth takes no part (it is not a depth of zero) and a depth edge shrinks the patch until it no longer holds it; a cell left
    without a patch is NaN.
    """

    patch_px: int = 10  # side of the averaged patch, paper section III-A
    max_patch_px: int = 26  # side it may grow to where depth is noisy
    noise_deg: float = 1.0  # the patch grows with range until the normal's predicted standard deviation is below this
    stride: int = 2  # px between cells of the output grid
    jump: float = 0.04  # a depth edge is a step above jump · z + jump_m
    jump_m: float = 0.02
    share: float = 0.5  # of a half patch's pixels that must have depth

    def __post_init__(self) -> None:
        if not 1 <= self.stride <= 8:
            raise ValueError("stride: must be 1 to 8 px")
        if not 3 * self.stride <= self.patch_px <= self.max_patch_px <= 100:
            raise ValueError("patch_px: must be at least 3 strides and at most max_patch_px <= 100")
        if self.noise_deg <= 0.0 or self.jump < 0.0 or self.jump_m <= 0.0:
            raise ValueError("noise_deg, jump, jump_m: must be positive")
        if not 0.0 < self.share <= 1.0:
            raise ValueError("share: must be in (0, 1]")

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells."""
        camera = frame.camera
        intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        radii = patch_radii(camera, self.noise_deg, self.patch_px, self.max_patch_px, self.stride)
        normals = patch_normals(frame.depth_m, self.stride, (self.patch_px, self.jump, self.jump_m), radii, self.share, intrinsics)
        return Normals(index=frame.index, stamp_ns=frame.stamp_ns, normals=normals, stride=self.stride)
