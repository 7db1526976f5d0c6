"""Names that plugins and their options had in earlier versions, accepted for one release."""

from __future__ import annotations

from trihedron.pipeline.core.renamed import rename_options

rename_options("pose", "refine", focal_off=None, focal_sure=None, focal_worse=None)  # `trihedron calibrate` checks the focal lengths
rename_options("relocalise", "pycolmap_pnp", draws=None, by_points=None, by_layout=None, angle_px=None, floor_m=None)  # it never read them

SURFACES = "open3d_poisson", "open3d_voxels", "planar_greedy", "planar_polygon", "planar_tsdf", "superpixels", "surfels", "tsdf"
for surface in SURFACES:
    rename_options("surface", surface, news="min_novelty")
