"""Open-loop planning protocols, occupancy, image quality: pure functions."""
