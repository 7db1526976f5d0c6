"""Bundle adjustment of a window of keyframes."""
