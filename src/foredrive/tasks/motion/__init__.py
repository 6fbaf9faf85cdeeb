"""Files of forecast agents: read, and scored under every protocol."""
