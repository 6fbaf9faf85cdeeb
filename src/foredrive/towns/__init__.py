"""The embedded world: towns that are generated on CARLA's road maps."""

import foredrive.data  # noqa: F401 - keeps Ray out of py123d, which is imported here, too
