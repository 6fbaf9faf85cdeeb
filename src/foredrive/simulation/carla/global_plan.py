"""The leaderboard's route: a few points, each with the road option that holds from there on."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from foredrive.data.commands import LOOKAHEAD_M
from foredrive.errors import InputError
from foredrive.geometry.polylines import arc_lengths
from foredrive.scene import Command
from foredrive.simulation.carla.frames import xyz_of
from foredrive.simulation.route_progress import RouteLine, RouteProgress

COMMAND_OF_OPTION = {
    "LEFT": Command.LEFT,
    "RIGHT": Command.RIGHT,
    "CHANGELANELEFT": Command.LEFT,
    "CHANGELANERIGHT": Command.RIGHT,
}
"""By the names of CARLA's `RoadOption`. All others (STRAIGHT, LANEFOLLOW, VOID) mean straight on."""


class GlobalPlan(RouteLine):
    """A route of N points with straight lines between them.

    Args:
        plan: a `carla.Transform` and a `RoadOption` for each point, as `set_global_plan` keeps them. An
            option holds from its point to the next.

    Raises:
        InputError: there are fewer than two points, or the route has no length.
    """

    def __init__(self, plan: Sequence[tuple[Any, Any]]) -> None:
        self.xy: Float64[np.ndarray, "N 2"] = np.array(
            [xyz_of(transform.location)[:2] for transform, _ in plan], dtype=float
        ).reshape(-1, 2)
        self._point_arc_m = arc_lengths(self.xy)
        if len(plan) < 2 or not self._point_arc_m[-1] > 0:
            raise InputError(f"a route needs at least two different points, got {len(plan)} points")
        self._commands = [COMMAND_OF_OPTION.get(option.name, Command.STRAIGHT) for _, option in plan]
        super().__init__(np.column_stack([self.xy, np.zeros(len(plan))]))

    def command(self, progress: RouteProgress) -> Command:
        """Return the first turn or lane change that is under way or begins within `LOOKAHEAD_M`.

        In training (`data.commands`) commands change at about the same place. The difference is bends outside
        of junctions, which the few points do not show.
        """
        first = int(np.searchsorted(self._point_arc_m, progress.done_m, side="right")) - 1
        last = int(np.searchsorted(self._point_arc_m, progress.done_m + LOOKAHEAD_M))
        soon = self._commands[max(first, 0) : max(last, 1)]
        return next((command for command in soon if command is not Command.STRAIGHT), Command.STRAIGHT)
