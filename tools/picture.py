"""Draw one frame of a recording with its features, and the map from above with the camera's path.

Example: trihedron picture runs/latest/run.mcap --frame 60 --out picture.png
"""

from __future__ import annotations

from pathlib import Path

from trihedron.comparison.pictures import draw
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Write the picture and say where."""
    parser = Parser("picture", __name__)
    parser.add_argument("recording", help="run.mcap")
    parser.add_argument("--frame", type=int, default=-1, metavar="N", help="frame number (default: the middle one)")
    parser.add_argument("--out", default="picture.png", metavar="FILE", help="default picture.png")
    options = parser.parse(argv)
    draw(options.recording, options.frame, Path(options.out))
    print(options.out)
    return 0
