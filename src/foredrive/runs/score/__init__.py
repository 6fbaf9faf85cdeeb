"""Score files of detections."""
