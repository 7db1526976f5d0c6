"""Sequences of the TAMU RGB-D data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from trihedron.datasets.readers.association import listed_pairs
from trihedron.datasets.readers.cameras import choose_calibration
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register


@register("dataset", "tamu")
@dataclass(frozen=True)
class Tamu(SequenceReader):
    """Folder with rgb.txt and depth.txt, as in the TUM benchmark, and a camera.yaml (Lu and Song 2015). Long walks through corridors, an entry
    hall and a staircase, without true poses: a walk ends where it began, so that `start_to_end_m` of metrics.json is its drift."""

    camera: str = ""  # preset or camera.yaml; empty = the folder's file
    max_difference_ms: PositiveFloat = 20.0  # of a pair's stamps
    depth_delay_ms: float = 0.0  # depth is taken this much later than its stamps, and by depth_delay_s of the camera file

    def _open(self, folder: Path) -> ImageSequence:
        calibration = choose_calibration(folder, self.camera)
        pairs = listed_pairs(folder, self.max_difference_ms, self.depth_delay_ms, calibration.depth_delay_s)
        return ImageSequence(*pairs[:3], calibration, depth_later_ns=pairs.depth_later_ns)
