"""Reconstruct logs as scenes that can be rendered."""
