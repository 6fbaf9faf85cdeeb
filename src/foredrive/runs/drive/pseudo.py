"""Pseudo-simulation of an agent in reconstructions, written as a summary."""

import functools
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from foredrive.data.logs import Log
from foredrive.data.road_maps import read_road_map
from foredrive.driving.epdms.pseudo_simulation import PseudoScore, PseudoSimulation, figures_of
from foredrive.driving.epdms.world import Roads
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.reconstructed import ReconstructedSimulator
from foredrive.engine.folder import SUMMARY
from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import Summary, write_summary
from foredrive.errors import InputError
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.agents import check_ready, is_remote
from foredrive.runs.drive.in_ncap import place_in
from foredrive.runs.drive.in_reconstruction import agent_in, check_lidar_of
from foredrive.runs.reconstruction.reconstruction_run import open_run_log

_log = logging.getLogger(__name__)


def pseudo_simulate(
    runs: Sequence[str],
    agent: str,
    out: Path,
    every_s: float,
    tick: Callable[[float], None] = lambda _: None,
) -> Summary:
    """Score an agent at several times of each reconstruction; write and return the summary.

    Args:
        every_s: time between two starts, s.
        tick: called with the score of each start that did not fail.

    Raises:
        InputError: there is no such agent, it remembers what it saw or cannot drive in a reconstruction, or a
            log is missing, has no map, or is too short for both stages.
    """
    if is_remote(agent):
        raise InputError(f"{agent}: a planner in another process is reset for each drive and needs its past")
    inputs = inputs_of(agent)
    check_ready(agent)
    scores, failed = list[PseudoScore](), 0
    for run in runs:
        sensors = inputs.cameras or inputs.lidar
        place = place_in(run, trusted=sensors, agent=agent)
        check_lidar_of(agent, None, place.vehicle, run)
        drive = LoggedDrive(place.vehicle, torch.eye(4))
        # an agent that cannot be made here is an error of the caller, and no failed start
        agent_in(
            agent,
            ReconstructedSimulator(place.renderer(place.graph), place.graph.all_tracks, drive, place.lanes),
        )
        simulation = PseudoSimulation(
            place,
            roads_of(run),
            functools.partial(agent_in, agent),
            inputs.past_frames,
            sensors=sensors,
        )
        starts = simulation.starts_s(every_s)
        if not starts:
            raise InputError(f"{run}: the log is too short for two stages of 3 s")
        for start_s in starts:
            try:
                scores.append(simulation.score(start_s))
            except Exception as error:  # any error of an agent is a failed start
                _log.warning("%s at %g s: %s", run, start_s, error)
                failed += 1
            else:
                tick(scores[-1].score)
    summary = {**figures_of(scores, failed), **collect_provenance(), "agent": agent}
    write_summary(out / SUMMARY, summary)
    return summary


def roads_of(run: str) -> Roads:
    """Return the roads of a reconstruction's log.

    Raises:
        InputError: the log is gone or has no map.
    """
    road_map = read_road_map(Log(open_run_log(Path(run))[1]))
    if road_map is None:
        raise InputError(f"{run}: its log has no map, which the EPDMS needs")
    return Roads(road_map)
