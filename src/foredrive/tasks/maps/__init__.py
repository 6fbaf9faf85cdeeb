"""Files of vector maps: read, and scored under every protocol."""
