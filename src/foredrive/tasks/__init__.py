"""Tasks, a folder each: truth, head, loss, metric, protocols and files of results."""
