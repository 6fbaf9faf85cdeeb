"""Pure tensor maths: rigid motions, projection, boxes, voxel indices. Frames as in docs/conventions.md."""
