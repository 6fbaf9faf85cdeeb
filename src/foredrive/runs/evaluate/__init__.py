"""Evaluate a run on logs, and look at what it predicts."""
