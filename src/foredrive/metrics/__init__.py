"""Metrics: pure functions of predictions and truth, summed up by `foredrive.evaluation`."""
