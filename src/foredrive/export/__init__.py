"""Export of a trained agent as one graph of plain tensors, for runtimes without this package."""
