"""Logs as a data set in the format of nuScenes v1.0, which nuscenes-devkit opens."""
