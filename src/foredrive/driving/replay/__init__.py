"""Drives in reconstructed logs."""
