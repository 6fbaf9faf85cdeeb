"""Drives in the embedded towns: the simulator, its expert and the rules of its lanes."""
