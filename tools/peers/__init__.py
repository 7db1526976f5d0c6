"""Other SLAM systems that `trihedron benchmark --peers` runs on the same frames, each in a process and an interpreter of its own."""
