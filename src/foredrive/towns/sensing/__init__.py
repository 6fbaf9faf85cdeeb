"""Simulation of the cameras and the lidar in a town: rays, light and lidar returns."""
