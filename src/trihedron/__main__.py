"""The command as a module, for a shell that does not find `trihedron` on its path: `python -m trihedron run FOLDER`."""

import sys

from trihedron.pipeline.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
