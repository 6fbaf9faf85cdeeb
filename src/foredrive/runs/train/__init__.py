"""Train a world model and its planner: a run folder with its stages and weights."""
