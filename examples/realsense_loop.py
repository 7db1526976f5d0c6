"""Track an Intel RealSense: pip install 'trihedron[realsense]'

python examples/realsense_loop.py [view=foxglove]        # Ctrl-C ends it; the run folder is runs/camera
"""

from __future__ import annotations

import sys

from camera_loop import command

if __name__ == "__main__":
    command("realsense", *sys.argv[1:])
