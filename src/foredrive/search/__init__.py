"""Finding data by asking for it: towers, an index of logs, queries."""
