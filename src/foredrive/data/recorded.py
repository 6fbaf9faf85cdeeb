"""Exact labels of recordings beyond 123D's own modalities, and states of traffic lights."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Float64, Int
from py123d.datatypes import ModalityType, TrafficLightStatus
from py123d.datatypes.custom.custom_modality import CustomModality
from torch import Tensor, from_numpy

from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.data.modalities import (
    BOX_ATTRIBUTE,
    BOX_VISIBILITY,
    CAPTION,
    EXPERT_PLAN,
    FULL_OCCUPANCY,
    SETTING,
    SIGNAL_LAMPS,
    FullOccupancy,
    unpack_attributes,
    unpack_lamps,
    unpack_occupancy,
    unpack_plan,
    unpack_visibility,
)
from foredrive.data.setting import Setting, unpack_setting
from foredrive.scene import Trajectory

T = TypeVar("T")


def read_visibility(log: Log, frame: int) -> Float[Tensor, "M"] | None:
    """Read the visible share of each box of `read_boxes`, 0 to 1. Return None if it was not recorded.

    Raises:
        InputError: the row cannot be read.
    """
    return _read(log, frame, BOX_VISIBILITY, lambda row: from_numpy(unpack_visibility(row.data)))


def read_attributes(log: Log, frame: int) -> Int[Tensor, "M"] | None:
    """Read the `Attribute` of each box of `read_boxes`, or `UNKNOWN`. Return None if it was not recorded.

    Raises:
        InputError: the row cannot be read.
    """
    return _read(log, frame, BOX_ATTRIBUTE, lambda row: from_numpy(unpack_attributes(row.data)))


def read_setting(log: Log, frame: int) -> Setting | None:
    """Read the setting of a frame. Return None if it was not recorded.

    Raises:
        InputError: the row cannot be read.
    """
    return _read(log, frame, SETTING, lambda row: unpack_setting(row.data))


def read_caption(log: Log, frame: int) -> str | None:
    """Read the English caption of the camera images. Return None if it was not recorded.

    Raises:
        InputError: the row cannot be read.
    """
    return _read(log, frame, CAPTION, lambda row: str(row.data["text"]))


def read_occupancy(log: Log, frame: int) -> FullOccupancy | None:
    """Read all occupied voxels, observed or not, in the frame's ego frame. Return None if not recorded.

    Raises:
        InputError: the row cannot be read.
    """
    return _read(log, frame, FULL_OCCUPANCY, lambda row: unpack_occupancy(row.data, row.metadata))


def read_expert_plan(log: Log, frame: int) -> Trajectory | None:
    """Read the expert's plan from a frame on, unbatched, in its ego frame. Return None if there is none.

    Raises:
        InputError: the row cannot be read.
    """
    return _read(log, frame, EXPERT_PLAN, lambda row: unpack_plan(row.data))


def read_traffic_lights(log: Log, frame: int) -> dict[int, TrafficLightStatus] | None:
    """Read the states of traffic lights by the map id of the lanes behind them. Return None if not logged.

    Raises:
        InputError: the row cannot be read.
    """
    file = log.file(ModalityType.TRAFFIC_LIGHT_DETECTIONS.serialize())
    with reading(file, f"the traffic lights at frame {frame}"):
        shown = log.scene.get_traffic_light_detections_at_iteration(log.iteration(frame))
        return None if shown is None else {int(light.lane_id): light.status for light in shown}


def read_signal_lamps(log: Log, frame: int) -> dict[int, Float64[np.ndarray, "_ 3"]] | None:
    """Read the places of lamps (world frame, m) by the lanes that they guard. Return None if not recorded.

    Raises:
        InputError: the row cannot be read.
    """
    return _read(log, frame, SIGNAL_LAMPS, lambda row: unpack_lamps(row.data))


def _read(log: Log, frame: int, name: str, unpack: Callable[[CustomModality], T]) -> T | None:
    """Unpack a frame's row of a custom modality. Return None if it was not recorded."""
    with reading(log.file(f"custom.{name}"), f"the {name.replace('_', ' ')} at frame {frame}"):
        row = log.scene.get_custom_modality_at_iteration(log.iteration(frame), name)
        return unpack(row) if isinstance(row, CustomModality) else None
