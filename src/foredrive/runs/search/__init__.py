"""Train towers, index logs and ask the index."""
