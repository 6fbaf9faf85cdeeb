"""Scenarios that the ego vehicle meets on its route, after those of CARLA's leaderboard 1.0."""
