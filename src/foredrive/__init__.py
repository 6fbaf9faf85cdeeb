"""Foredrive: the learning loop of autonomous driving, from logs to plans and back."""

__version__ = "0.1.0.dev0"
