"""What moves in a town: vehicles, people, lights, and the expert who drives through them."""
