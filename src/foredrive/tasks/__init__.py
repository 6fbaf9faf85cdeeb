"""Tasks, a folder each: metrics, protocols and files of results."""
