"""The evaluation that runs a list of metrics over predictions."""
