"""The planner on a world model, and planners that see only the ego status."""
