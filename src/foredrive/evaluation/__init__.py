"""Evaluations: predictions and truth in, one flat summary out."""
