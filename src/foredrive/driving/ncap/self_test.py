"""Self-test of scenarios: a vehicle that takes no action has to hit something in every run.

After neuro-ncap's `tests/test_scenarios_crash.py`. A run that passes by itself tells nothing about an agent,
so a scenario with such a run is named and left out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from foredrive.driving.ncap.drawing import draw_run
from foredrive.driving.ncap.rules import Rules
from foredrive.driving.ncap.running import Place, drive_without_action, reference_mps
from foredrive.driving.ncap.scenario import SafetyScenario
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.errors import InputError

MIN_REFERENCE_MPS = 0.1
"""Smallest reference speed by which an impact can be judged, m/s."""


@dataclass(frozen=True)
class SelfTest:
    """Result of the self-test."""

    passed: tuple[SafetyScenario, ...]
    left_out: Mapping[str, str]
    """Reason for each scenario that is left out, by its label."""

    @property
    def reasons(self) -> str:
        """Return the scenarios that are left out, each with its reason, in one line."""
        return "; ".join(f"{label}: {why}" for label, why in self.left_out.items())


def self_test(
    scenarios: Sequence[SafetyScenario],
    place_of: Callable[[SafetyScenario], Place],
    count: int,
    rules: Rules,
) -> SelfTest:
    """Drive `count` runs of each scenario without any action.

    Args:
        place_of: returns the reconstructed log of a scenario; raises InputError if there is none.
    """
    passed, left_out = list[SafetyScenario](), dict[str, str]()
    for scenario in scenarios:
        try:
            place = place_of(scenario)
            for number in range(count):
                run_reference(place, scenario, number, rules)
        except InputError as error:
            left_out[scenario.label] = str(error).removeprefix(f"{scenario.label}: ")
            continue
        passed.append(scenario)
    return SelfTest(tuple(passed), left_out)


def run_reference(place: Place, scenario: SafetyScenario, number: int, rules: Rules) -> float:
    """Return the reference speed of a run, m/s.

    Raises:
        InputError: nothing is hit without any action, or the reference speed is 0.
    """
    impact_mps = drive_without_action(place, scenario, number, rules)
    if impact_mps is None:
        raise InputError(f"run {number} passes without any action")
    drive = LoggedDrive(place.vehicle, torch.eye(4))
    speed_mps = reference_mps(rules, drive, draw_run(scenario, number), impact_mps)
    if speed_mps < MIN_REFERENCE_MPS:
        raise InputError(
            f"the reference speed of run {number} is {speed_mps:.2f} m/s, so that no impact can be judged"
        )
    return speed_mps
