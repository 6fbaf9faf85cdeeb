"""Remembers the stop signs of a drive: each stops the vehicle until it has stood there and given way."""

import numpy as np
from jaxtyping import Bool

from foredrive.data.truth.affordances import PASSED_M
from foredrive.driving.lane_rules import STOP_WITHIN_M, STOPPED_MPS
from foredrive.scene.affordances import CELL_M

OTHER_M = 6.0
"""Difference from the remembered distance by which a reading is of another sign."""
SHARE = 0.5
"""Share by which a reading moves the remembered line."""
UNSEEN, IN_VIEW_M = 4, 6.0
"""Readings without a sign after which it is forgotten, where its line should be in view: from this far on."""
TOO_LATE_M = -1.0
"""Distance of the line from which the vehicle does not stop any more."""
CROSSING_M, PATIENCE = 16.0, 20
"""Length of the path behind the line that has to be free of road users before the vehicle goes on, and the
updates after which it goes on all the same."""


class StopSigns:
    """Remembers the next stop sign.

    Args:
        confirmed: readings of a line at about the same place from which it counts.
    """

    def __init__(self, confirmed: int = 1) -> None:
        self._confirmed = confirmed
        self._line_m: float | None = None
        self._readings, self._unseen = 0, 0
        self._has_stood, self._waited, self._goes = False, 0, False

    def update(
        self,
        sign_m: float | None,
        moved_m: float,
        speed_mps: float,
        occupied: Bool[np.ndarray, "T G"] | None = None,
    ) -> float | None:
        """Return the distance of the line at which the vehicle still has to stop, m, or None.

        Args:
            sign_m: distance of the line of the next sign from the front bumper as it is read now, or None.
            moved_m: distance driven since the reading before.
            speed_mps: speed of the vehicle.
            occupied: who is expected on the path, as in `Affordances`. None: nobody.
        """
        # The line comes nearer by the distance driven
        if self._line_m is not None:
            self._line_m -= moved_m
            if self._line_m < -PASSED_M:
                self._line_m = None
        if sign_m is not None:
            self._read(sign_m)
        # A line that should be in view and is not seen again was none
        elif self._line_m is not None and self._line_m > IN_VIEW_M:
            self._unseen += 1
            if self._unseen >= UNSEEN:
                self._line_m = None
        if self._line_m is None or self._readings < self._confirmed:
            return None
        # A stop counts as the rules count it (`lane_rules`)
        self._has_stood |= speed_mps < STOPPED_MPS and TOO_LATE_M < self._line_m < STOP_WITHIN_M
        if self._has_stood and not self._goes:
            # It gives way to those who come into the junction, but not for ever
            self._waited += 1
            self._goes = self._waited > PATIENCE or not _is_crossed(occupied, self._line_m)
        return None if self._goes or self._line_m < TOO_LATE_M else self._line_m

    def _read(self, sign_m: float) -> None:
        self._unseen = 0
        beyond_m = None if self._line_m is None else sign_m - self._line_m
        if beyond_m is not None and abs(beyond_m) <= OTHER_M and self._line_m is not None:
            self._line_m += SHARE * beyond_m
            self._readings += 1
        elif beyond_m is None or beyond_m < 0 or self._has_stood:
            # The first one, a nearer one, or the next one behind a line that has been waited at
            self._line_m, self._readings = sign_m, 1
            self._has_stood, self._waited, self._goes = False, 0, False


def _is_crossed(occupied: Bool[np.ndarray, "T G"] | None, line_m: float) -> bool:
    """Return whether somebody comes into the path behind a line."""
    if occupied is None:
        return False
    first = int(max(line_m, 0.0) / CELL_M)
    return bool(occupied[:, first : first + int(CROSSING_M / CELL_M)].any())
