"""The published protocols of occupancy: semantic voxels, rays through them, instances seen from above."""
