"""The real CARLA, both ways: its server as a `Simulator`, and Foredrive's agents in its leaderboards.

The package `carla` (0.9.16, the optional extra of that name) is imported late and in `client` alone;
everything else takes its objects as they are. `docs/carla.md` says what of this has met a server.
"""
