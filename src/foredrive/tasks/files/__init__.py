"""Files of results and of ground truth, for all tasks."""
