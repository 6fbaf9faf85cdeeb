"""Ground truth of tasks at the now of a clip."""
