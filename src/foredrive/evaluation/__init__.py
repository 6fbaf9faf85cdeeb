"""Runs evaluations: predictions and truth in, one flat summary out."""
