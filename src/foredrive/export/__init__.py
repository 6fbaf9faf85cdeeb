"""A trained agent as one graph of plain tensors, for runtimes that know nothing of this package."""
