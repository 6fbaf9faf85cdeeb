"""Closed-loop simulation: motion of the ego vehicle, plan following, routes, scenarios and scores."""
