"""The map: its columns, what a keyframe adds, what is searched in it, how it is corrected."""
