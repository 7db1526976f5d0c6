"""Depth images: sampling, noise, normals, 3D lines."""
