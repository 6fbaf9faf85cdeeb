"""An agent in another process, behind neuro-ncap's model server protocol: its UniAD and VAD, for example."""

import dataclasses
import time
from collections.abc import Callable

from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.integrations.remote.planner_messages import PlannerOutput, planner_input, waypoints
from foredrive.json_http import Address, ask, validated
from foredrive.scene import Clip, Trajectory

FIRST_US = 1_000_000_000
"""Time of the start of a drive that planners are told, µs. Key frames before it have positive times too."""
ALIVE_S = 20.0
"""Time in which a planner has to be alive before the first drive, s."""


class HttpPlanner:
    """An `Agent` that asks a model server. All its errors end the drive as a failed one.

    The server keeps what it has seen. It is reset before the first plan, and then sent each key frame once:
    the frames before the start too, whose plans are not used, as in neuro-ncap's priming.

    Args:
        address: address of the server.
        clock: returns the time of the drive, s.
        cameras, lidar: what the planner is shown.
    """

    def __init__(
        self, address: Address, clock: Callable[[], float], *, cameras: bool = True, lidar: bool = False
    ) -> None:
        self._address, self._clock = address, clock
        self._cameras, self._lidar = cameras, lidar
        self._sent_us: int | None = None

    def act(self, observation: Clip) -> Trajectory:
        """Return the planner's plan, for a batch of one.

        Raises:
            InputError: the planner answers too late, an error, or no plan.
        """
        clip = observation[0]
        if self._sent_us is None:
            ask(self._address, "/reset", {})
        answer = None
        for frame, t_s in enumerate(clip.t_s[: clip.now + 1].tolist()):
            at_us = FIRST_US + round((self._clock() + t_s) * 1e6)
            if self._sent_us is None or at_us > self._sent_us:
                asked = planner_input(clip, frame, at_us, cameras=self._cameras, lidar=self._lidar)
                body = dataclasses.asdict(asked)
                if asked.sweeps is None:
                    del body["sweeps"]
                answer = ask(self._address, "/infer", body)
                self._sent_us = at_us
        if answer is None:
            raise InputError("a planner was asked twice at one time")
        output = validated(PlannerOutput, answer, f"http://{self._address}/infer")
        return plan_of(waypoints(output)[None, None])


def check_planner(address: Address, within_s: float = ALIVE_S) -> None:
    """Wait until a model server is alive.

    Raises:
        InputError: it is not within some time. The message has the reason of the last attempt.
    """
    began = time.monotonic()
    brief = dataclasses.replace(address, answer_s=min(address.answer_s, within_s))
    while True:
        try:
            ask(brief, "/alive")
        except InputError as error:
            if time.monotonic() - began >= within_s:
                raise InputError(f"no planner is alive: {error}") from error
            time.sleep(min(1.0, within_s))
        else:
            return
