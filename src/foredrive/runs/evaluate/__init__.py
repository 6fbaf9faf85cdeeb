"""Evaluate a run on logs, and inspect its predictions."""
