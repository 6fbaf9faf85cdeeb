"""Drives in rebuilt logs."""
