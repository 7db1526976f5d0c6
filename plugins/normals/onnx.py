"""Learned normals by a network in an ONNX file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import cv2
import numpy as np

from trihedron.pipeline.core.options import OneOf, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.shared.networks import NetworkOptions, network_image

Sign = Annotated[int, OneOf(-1, 1)]


@register("normals", "onnx")
@dataclass(frozen=True)
class OnnxNormals(NetworkOptions):
    """Normals of a network that the user gives (Omnidata: Eftekhar et al., ICCV 2021; DSINE: Bae and Davison, CVPR 2024): `image` (1, 3, h, w) RGB in
    0 … 1 to `normals` (1, 3, h', w') in camera axes, whose signs are changed to x right, y down, z forward by `sign_*`.

    Given where there is depth, and turned towards the camera. Library: ONNX Runtime (MIT), one thread. The bytes may differ on another CPU."""

    slot: ClassVar[str] = "normals"
    stride: Annotated[int, Range(1, 8)] = 4  # px between cells of the output grid
    multiple: PositiveInt = 32  # of which the image's sides are one
    sign_x: Sign = 1
    sign_y: Sign = 1
    sign_z: Sign = 1

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN without depth."""
        network, depth = self.network, frame.depth_m[:: self.stride, :: self.stride]
        image = network_image(frame, network, "image", 3, self.multiple)
        found = network.rows("normals", network.run({"image": image.tensor}, ("normals",))[0], 3, None, None)
        rows, columns = np.indices(depth.shape, np.float64) * self.stride
        own = image.own(np.stack([columns, rows], axis=-1))
        at = ((own + 0.5) * (np.array(found.shape[:0:-1]) / image.tensor.shape[:1:-1]) - 0.5).astype(np.float32)
        inside = (at > -1.0).all(axis=-1) & (at < found.shape[:0:-1]).all(axis=-1)
        planes = [cv2.remap(plane, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in found]
        normals = np.stack(planes, axis=-1) * np.array([self.sign_x, self.sign_y, self.sign_z], np.float32)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = normals / np.maximum(length, 1e-9)
        rays = frame.camera.back_project(np.stack([columns, rows], axis=-1), np.ones(depth.shape))
        normals = np.where((normals * rays).sum(axis=-1, keepdims=True) > 0.0, -normals, normals)
        seen = (depth > 0.0) & inside & (length[..., 0] > 1e-3)
        normals = np.where(seen[..., None], normals, np.nan)
        return Normals(index=frame.index, stamp_ns=frame.stamp_ns, normals=np.ascontiguousarray(normals, np.float32), stride=self.stride)
