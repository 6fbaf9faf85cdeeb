"""Heads that learn the tasks on a volume: they share one plane, one decoder and one training."""
