"""Track a Luxonis OAK-D: pip install 'depthai>=3'

python examples/oak_loop.py [view=foxglove]        # Ctrl-C ends it; the run folder is runs/camera
"""

from __future__ import annotations

import sys

from camera_loop import command

if __name__ == "__main__":
    command("oak", *sys.argv[1:])
