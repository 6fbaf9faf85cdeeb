"""Export of a trained agent as one graph of plain tensors, and of logs in the formats of other tools."""
