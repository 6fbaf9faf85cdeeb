"""Interface to CARLA: its server as a `Simulator`, and Foredrive's agents in its leaderboards.

The package `carla` (0.9.16 or 0.9.15, the optional extras `carla` and `carla-0915`) is imported only when it
is needed, and only in `client`. All other modules take its objects as arguments. It was never run with a
server: `docs/how-to/other-tools.md` says what was tried.
"""
