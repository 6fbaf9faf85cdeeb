"""Training loops, checkpoints, processes, run folders and benchmarks; knows no task and no method."""
