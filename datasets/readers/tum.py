"""Sequences of the TUM RGB-D benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from trihedron.datasets.readers.association import listed_pairs
from trihedron.datasets.readers.cameras import choose_calibration, with_noise
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.record.trajectories import TRUTH, read_trajectory


@register("dataset", "tum")
@dataclass(frozen=True)
class Tum(SequenceReader):
    """Folder with rgb.txt, depth.txt and, where there is truth, groundtruth.txt (Sturm et al. 2012). Colour and depth are separate streams,
    paired by time; a frame carries the stamp of its colour image, and depth is turned to that time. fr1 and fr2 are undistorted at reading. The
    benchmark's cameras have rolling shutters, of 20 ms or more: such are assumed where a camera file states none, but has the numbers of one."""

    camera: str = ""  # preset or camera.yaml; empty = the folder's file, else its name
    max_difference_ms: PositiveFloat = 20.0  # of a pair's stamps; the benchmark's tools use the same
    depth_delay_ms: float = 0.0  # depth is taken this much later than its stamps, and by depth_delay_s of the camera file
    exact_depth: bool = False  # rendered without sensor noise; false = a Kinect's

    def _open(self, folder: Path) -> ImageSequence:
        calibration = with_noise(choose_calibration(folder, self.camera, readout_s=0.0 if self.exact_depth else None), self.exact_depth)
        truth = read_trajectory(folder / TRUTH) if (folder / TRUTH).is_file() else None
        pairs = listed_pairs(folder, self.max_difference_ms, self.depth_delay_ms, calibration.depth_delay_s)
        return ImageSequence(*pairs[:3], calibration, truth, depth_later_ns=pairs.depth_later_ns)
