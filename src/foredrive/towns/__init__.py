"""The embedded world, grown on CARLA's road maps."""
