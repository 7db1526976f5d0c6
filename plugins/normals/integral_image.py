"""Normals by integral images: the paper's choice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveShare, Range, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.integral_image_kernels import patch_normals
from trihedron.plugins.normals.patch_size import patch_radii


@register("normals", "integral_image")
@dataclass(frozen=True)
class IntegralImage:
    """Average the tangent vectors of a patch by integral images (Holzer et al., IROS 2012; paper, section III-A).

    Missing depth takes no part (it is not a depth of zero) and a depth edge shrinks the patch until it no longer holds it; a cell left
    without a patch is NaN.
    """

    patch_px: Annotated[int, Range(3, 100)] = 10  # side of the averaged patch, paper section III-A
    max_patch_px: Annotated[int, Range(3, 100)] = 26  # side it may grow to where depth is noisy
    noise_deg: PositiveFloat = 1.0  # the patch grows with range until the normal's predicted standard deviation is below this
    stride: Annotated[int, Range(1, 8)] = 2  # px between cells of the output grid
    jump: NonNegativeFloat = 0.04  # a depth edge is a step above jump · z + jump_m
    jump_m: PositiveFloat = 0.02
    share: PositiveShare = 0.5  # of a half patch's pixels that must have depth

    def __post_init__(self) -> None:
        check_increasing(self, "patch_px", "max_patch_px")
        if self.patch_px < 3 * self.stride:
            raise ValueError(f"patch_px: {self.patch_px} is less than three strides of {self.stride} px")

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells."""
        camera = frame.camera
        intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        radii = patch_radii(camera, self.noise_deg, self.patch_px, self.max_patch_px, self.stride)
        normals = patch_normals(frame.depth_m, self.stride, (self.patch_px, self.jump, self.jump_m), radii, self.share, intrinsics)
        return Normals(index=frame.index, stamp_ns=frame.stamp_ns, normals=normals, stride=self.stride)
