"""Evaluate a run on logs, and predict single examples for pictures."""
