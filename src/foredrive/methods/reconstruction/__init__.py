"""Rendering of sensors in scenes made of Gaussians."""
