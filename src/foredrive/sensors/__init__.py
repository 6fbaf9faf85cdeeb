"""Camera and lidar models: pixels and beams to timed rays."""
