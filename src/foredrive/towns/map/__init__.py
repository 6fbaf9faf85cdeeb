"""The map of a town: lanes, stop zones and surfaces, read from its OpenDRIVE file."""
