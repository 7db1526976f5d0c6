"""RGB-D SLAM for man-made scenes: swappable stages, recorded topics, single-stage replay."""
