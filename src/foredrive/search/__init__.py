"""Search in driving logs: towers (encoders), an index of logs, queries."""
