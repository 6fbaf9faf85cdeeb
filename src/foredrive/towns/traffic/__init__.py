"""The moving parts of a town: vehicles, people, lights, and the expert that drives through the traffic."""
