"""Files of semantic voxels, read and scored under the published protocols of occupancy."""
