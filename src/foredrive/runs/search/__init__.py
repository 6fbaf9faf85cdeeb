"""Train retrieval towers, index logs and query the index."""
