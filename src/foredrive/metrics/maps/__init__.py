"""Maps around the ego vehicle, raster and vector, judged by every published protocol."""
