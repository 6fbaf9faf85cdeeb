"""123D logs to clips and back: reading, labels, datasets, writing."""
