"""Files of detections: read, scored as random finite sets and by the usual metrics, compared."""
