"""The driving command at a frame: from the log's route, or else from the driven future."""

import numpy as np
from py123d.datatypes import ModalityType, RouteMetadata

from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.scene import Command, Trajectory

LATERAL_M = 2.0
"""nuScenes convention (ST-P3, UniAD, VAD): further to the side than this is a turn."""
LOOKAHEAD_M = 20.0
"""How far ahead the route is asked: about three seconds of city driving."""


def command_at(log: Log, frame: int, future: Trajectory) -> tuple[Command | None, str]:
    """The command and its source: "route", "driven_future" or "none".

    The driven future leaks what an agent is judged on, hence the source. A route counts only if it was given
    to the vehicle: py123d derives one from the driven path where there is none.

    Raises:
        InputError: on a route that cannot be read.
    """
    lateral_m = _route_offset_m(log, frame)
    if lateral_m is not None:
        return _command(lateral_m), "route"
    valid = future.valid[0].numpy()
    if not valid.any():
        return None, "none"
    return _command(float(future.xy[0, np.flatnonzero(valid)[-1], 1])), "driven_future"


def _command(lateral_m: float) -> Command:
    if lateral_m >= LATERAL_M:
        return Command.LEFT
    return Command.RIGHT if lateral_m <= -LATERAL_M else Command.STRAIGHT


def _route_offset_m(log: Log, frame: int) -> float | None:
    """How far left of the ego heading the route lies LOOKAHEAD_M ahead; None without a provided route."""
    metadata = log.scene.get_modality_metadata(ModalityType.ROUTE_POSITION)
    if not isinstance(metadata, RouteMetadata) or metadata.source != "provided":
        return None
    with reading(log.file(metadata.modality_key), f"the route at frame {frame}"):
        progress_m = log.scene.get_route_progress_at_iteration(log.iteration(frame))
        if progress_m is None:
            return None
        arc_m, xyz = metadata.polyline_arc_m, metadata.polyline_xyz
        ahead = [np.interp(progress_m + LOOKAHEAD_M, arc_m, xyz[:, axis]) for axis in range(3)]
        return float((np.linalg.inv(log.T_world_ego[frame]) @ [*ahead, 1.0])[1])
