"""Criteria: pure functions of predictions and labels."""
