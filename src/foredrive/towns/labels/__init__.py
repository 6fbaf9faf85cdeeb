"""What is true in a town: exact labels of what was sensed."""
