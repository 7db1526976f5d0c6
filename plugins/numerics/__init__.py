"""Numerics shared by several plugins, in groups that import one way: algebra, images, depth, planes, axes, motion, maps, bundle, places."""
