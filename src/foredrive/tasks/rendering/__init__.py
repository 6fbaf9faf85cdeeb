"""Rendered images and sweeps against real ones."""
