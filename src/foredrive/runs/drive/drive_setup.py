"""Everything that one drive needs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from foredrive.data.log_writer import Frame, LogWriter
from foredrive.driving.drive import Drive, Pilot
from foredrive.driving.ncap.outcome import SafetyResult
from foredrive.scene import Agent, Simulator


@dataclass(frozen=True, eq=False)
class DriveSetup:
    """Everything that one drive needs, already set up."""

    simulator: Simulator
    scenario: object
    """The argument of the simulator's `reset`."""
    agent: Agent
    route_xyz: Float64[np.ndarray, "N 3"]
    length_m: float
    """Length of the route, m."""
    log: LogWriter
    frame: Callable[[], Frame]
    """Returns the frame to log for the latest key frame."""
    town: str | None = None
    """The town whose map is used; None: there is no map."""
    lanes_known: bool = True
    judge: Callable[[Drive], SafetyResult | None] = lambda drive: None
    """Scores the drive against a threat; None: there is no threat."""
    trusted_share: Callable[[], float | None] = lambda: None
    """Returns the share of the drive's key frames whose images are trusted."""
    pilot: Pilot | None = None
    """Moves the vehicle along the plans; None: as `drive_route` does by itself."""
