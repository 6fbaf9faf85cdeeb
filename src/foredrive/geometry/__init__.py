"""Tensor maths: rigid motions, projection, boxes, voxel indices. Frames are defined in docs/conventions.md."""
