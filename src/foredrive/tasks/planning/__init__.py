"""Plans: their losses, and the protocols that score them against the driven future."""
