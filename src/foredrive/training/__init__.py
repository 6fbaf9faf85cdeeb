"""The training loop, checkpoints, resuming, logging."""
