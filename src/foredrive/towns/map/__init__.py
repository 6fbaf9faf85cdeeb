"""A town's map: lanes, stop zones and surfaces as the OpenDRIVE file has them."""
