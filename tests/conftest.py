"""Tests compile what they call; none fills the cache for the whole default graph first."""

import os

os.environ["TRIHEDRON_COMPILE"] = "0"
