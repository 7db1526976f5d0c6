"""Motion between frames and the pose solver."""
