"""A driver by sight: what is on its route, seen by cameras, and the speed at which to drive along it."""
