"""Detections and tracks in files, and their ground truth: read, and scored under every protocol."""
