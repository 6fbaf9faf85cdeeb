"""Heads of the downstream tasks: agents, map elements, semantic voxels, all on one plane module."""
