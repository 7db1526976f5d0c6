"""Planar regions: growing, fitting, merging, associating."""
