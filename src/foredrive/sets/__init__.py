"""Random finite sets: a detector's word as a density over sets of objects, and how likely the truth is."""
