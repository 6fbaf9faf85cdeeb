"""Exact labels of recordings: what they carry beyond 123D's own modalities, and what traffic lights show."""

from jaxtyping import Float
from py123d.datatypes import ModalityType, TrafficLightStatus
from py123d.datatypes.custom.custom_modality import CustomModality
from torch import Tensor, from_numpy

from foredrive.data.arrow_files import reading
from foredrive.data.logs import Log
from foredrive.data.modalities import (
    BOX_VISIBILITY,
    CAPTION,
    FULL_OCCUPANCY,
    SETTING,
    TAUGHT_PLAN,
    FullOccupancy,
    unpack_occupancy,
    unpack_plan,
    unpack_visibility,
)
from foredrive.data.setting import Setting, unpack_setting
from foredrive.scene import Trajectory


def read_visibility(log: Log, frame: int) -> Float[Tensor, "M"] | None:
    """How much of each box of `read_boxes` the cameras see, 0 to 1; None if it was not recorded.

    Raises:
        InputError: on a row that cannot be read.
    """
    with reading(log.file(f"custom.{BOX_VISIBILITY}"), f"the visibility at frame {frame}"):
        row = _row(log, frame, BOX_VISIBILITY)
        return None if row is None else from_numpy(unpack_visibility(row.data))


def read_setting(log: Log, frame: int) -> Setting | None:
    """Return the facts of a frame; None if they were not recorded.

    Raises:
        InputError: on a row that cannot be read.
    """
    with reading(log.file(f"custom.{SETTING}"), f"the setting at frame {frame}"):
        row = _row(log, frame, SETTING)
        return None if row is None else unpack_setting(row.data)


def read_caption(log: Log, frame: int) -> str | None:
    """What the cameras see in plain English; None if it was not recorded.

    Raises:
        InputError: on a row that cannot be read.
    """
    with reading(log.file(f"custom.{CAPTION}"), f"the caption at frame {frame}"):
        row = _row(log, frame, CAPTION)
        return None if row is None else str(row.data["text"])


def read_occupancy(log: Log, frame: int) -> FullOccupancy | None:
    """Every occupied voxel, seen or not, in the frame's ego frame; None if it was not recorded.

    Raises:
        InputError: on a row that cannot be read.
    """
    with reading(log.file(f"custom.{FULL_OCCUPANCY}"), f"the occupancy at frame {frame}"):
        row = _row(log, frame, FULL_OCCUPANCY)
        return None if row is None else unpack_occupancy(row.data, row.metadata)


def read_taught_plan(log: Log, frame: int) -> Trajectory | None:
    """What the teacher would do from a frame on, unbatched, in its ego frame; None if nobody was asked.

    Raises:
        InputError: on a row that cannot be read.
    """
    with reading(log.file(f"custom.{TAUGHT_PLAN}"), f"the taught plan at frame {frame}"):
        row = _row(log, frame, TAUGHT_PLAN)
        return None if row is None else unpack_plan(row.data)


def read_traffic_lights(log: Log, frame: int) -> dict[int, TrafficLightStatus] | None:
    """What lights show, by the map's id of each lane that begins behind one; None if the log does not tell.

    Raises:
        InputError: on a row that cannot be read.
    """
    file = log.file(ModalityType.TRAFFIC_LIGHT_DETECTIONS.serialize())
    with reading(file, f"the traffic lights at frame {frame}"):
        shown = log.scene.get_traffic_light_detections_at_iteration(log.iteration(frame))
        return None if shown is None else {int(light.lane_id): light.status for light in shown}


def _row(log: Log, frame: int, kind: str) -> CustomModality | None:
    row = log.scene.get_custom_modality_at_iteration(log.iteration(frame), kind)
    return row if isinstance(row, CustomModality) else None
