"""Exact labels of the sensor data from a town."""
