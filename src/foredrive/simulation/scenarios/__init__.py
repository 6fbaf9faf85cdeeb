"""What others do to the ego vehicle on its way, after the scenarios of CARLA's leaderboard 1.0."""
